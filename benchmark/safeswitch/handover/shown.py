"""The same states seen with a disturbance: how a signal is judged where only the picture is disturbed.

The states are those of undisturbed episodes, which the learner knows. On the trajectory of a disturbed episode a signal
would also be judged in states that the learner has never been in, once it is thrown off: there both views are novel to
it, and what is measured is the consequence and no longer the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from safeswitch.handover.table import Bools, HandoverTable
from safeswitch.protocols import Array, Learner, Signal

if TYPE_CHECKING:
    from safeswitch.tasks.base import TaskEnv


def shown_traces(
    env: TaskEnv, learner: Learner, signals: Sequence[Signal], undisturbed: HandoverTable
) -> tuple[dict[str, Array], Bools]:
    """Signals on the states of undisturbed episodes, observed under the disturbance from its onset on.

    Args:
        env: the unwrapped task in a cell whose disturbance is only seen, so that states mean the same with and without.
        learner: as recorded; the actions stay those of the recorded trajectory.
        signals: as recorded.
        undisturbed: a table of undisturbed episodes as it was recorded or loaded, with its snapshots.

    Returns:
        Signal id -> (E, T), NaN after an early end; and (E, T) whether the disturbance shows in the observation.
    """
    if undisturbed.snapshots is None:
        raise ValueError("the states of a table are in its snapshots: take it as it was recorded or loaded")
    if undisturbed.disturbed.any():
        raise ValueError("the states of undisturbed episodes are needed, this table has disturbed ones")
    shape = (len(undisturbed), undisturbed.horizon)
    traces = {signal.id: np.full(shape, np.nan) for signal in signals}
    visible = np.zeros(shape, bool)
    for episode, seed in enumerate(undisturbed.seeds):
        env.reset(seed=int(seed))
        learner.reset(int(seed))
        for signal in signals:
            signal.reset()
        for step in range(int(undisturbed.length[episode])):
            env.restore(undisturbed.snapshots[episode, step])
            observation = env.observe()
            visible[episode, step] = env.disturbed and not np.array_equal(observation, env.observe(clean=True))
            prediction = learner.predict(observation, step)
            executed = env.simulator.action.copy() if step else None
            for signal in signals:
                traces[signal.id][episode, step] = signal.update(observation, prediction, executed)
    return traces, visible
