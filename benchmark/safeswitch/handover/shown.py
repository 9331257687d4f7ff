"""The same states seen with a disturbance: how a signal is judged where only the picture is disturbed.

The states are those of undisturbed episodes, which the learner knows. On the trajectory of a disturbed episode a signal
would also be judged in states that the learner has never been in, once it is thrown off: there both views are novel to
it, and what is measured is the consequence and no longer the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from safeswitch.handover.table import Bools, HandoverTable
from safeswitch.protocols import Array, Learner, Signal

if TYPE_CHECKING:
    from safeswitch.tasks.base import TaskEnv


JUDGED = (1.5, 5.0)
"""Distances between which frames with a placed disturbance ahead are judged [m]: closer it fills the picture, further
away it is a few pixels."""


@dataclass(frozen=True)
class Shown:
    """Undisturbed episodes seen with a disturbance.

    Attributes:
        traces: signal id -> (E, T), NaN after an early end.
        visible: (E, T) whether the disturbance shows in the observation.
        distance: (E, T) distance to what stands ahead [m], negative behind it; NaN where nothing is placed.
        kinds: which kind of the disturbance each of the E episodes has.
    """

    traces: dict[str, Array]
    visible: Bools
    distance: Array
    kinds: tuple[str, ...]

    @property
    def judged(self) -> Bools:
        """(E, T) frames in which a signal should see the disturbance."""
        nearest, furthest = JUDGED
        near = (self.distance >= nearest) & (self.distance <= furthest)
        return self.visible & (np.isnan(self.distance) | near)


def shown_traces(env: TaskEnv, learner: Learner, signals: Sequence[Signal], undisturbed: HandoverTable) -> Shown:
    """Signals on the states of undisturbed episodes, observed under the disturbance from its onset on.

    Args:
        env: the unwrapped task in a cell whose disturbance can be shown on any state: it is only seen, or it is placed,
            and what stands ahead does not yet touch.
        learner: as recorded; the actions stay those of the recorded trajectory.
        signals: as recorded.
        undisturbed: a table of undisturbed episodes as it was recorded or loaded, with its snapshots.
    """
    if undisturbed.snapshots is None:
        raise ValueError("the states of a table are in its snapshots: take it as it was recorded or loaded")
    if undisturbed.disturbed.any():
        raise ValueError("the states of undisturbed episodes are needed, this table has disturbed ones")
    shape = (len(undisturbed), undisturbed.horizon)
    traces = {signal.id: np.full(shape, np.nan) for signal in signals}
    visible, distance, kinds = np.zeros(shape, bool), np.full(shape, np.nan), []
    for episode, seed in enumerate(undisturbed.seeds):
        env.reset(seed=int(seed))
        kinds.append("" if env.disturbance is None else env.disturbance.drawn)
        learner.reset(int(seed))
        for signal in signals:
            signal.reset()
        for step in range(int(undisturbed.length[episode])):
            env.restore(undisturbed.snapshots[episode, step])
            observation = env.observe()
            visible[episode, step] = env.disturbed and not np.array_equal(observation, env.observe(clean=True))
            distance[episode, step] = env.distance_ahead()
            prediction = learner.predict(observation, step)
            executed = env.simulator.action.copy() if step else None
            for signal in signals:
                traces[signal.id][episode, step] = signal.update(observation, prediction, executed)
    return Shown(traces, visible, distance, tuple(kinds))
