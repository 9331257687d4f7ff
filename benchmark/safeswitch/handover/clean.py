"""The same states seen without the disturbance: what a signal is compared with where only the picture is disturbed.

An undisturbed twin soon visits other states than the disturbed episode, so that a signal could tell the two apart by
the states alone. Here the learner is shown the states of the disturbed trajectory itself, every frame rendered without
the disturbance, its memory included.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from safeswitch.handover.table import Bools, HandoverTable
from safeswitch.protocols import Array, Learner, Signal

if TYPE_CHECKING:
    from safeswitch.tasks.base import TaskEnv


def clean_traces(
    env: TaskEnv, learner: Learner, signals: Sequence[Signal], table: HandoverTable
) -> tuple[dict[str, Array], Bools]:
    """Signals on the states of recorded episodes, observed without the disturbance.

    Args:
        env: the unwrapped task in the cell of the table.
        learner: as recorded; the actions stay those of the recorded trajectory.
        signals: as recorded.
        table: as recorded or loaded, with its snapshots.

    Returns:
        Signal id -> (E, T), NaN after an early end; and (E, T) whether the disturbance shows in the observation.
    """
    if table.snapshots is None:
        raise ValueError("the states of a table are in its snapshots: take it as it was recorded or loaded")
    traces = {signal.id: np.full((len(table), table.horizon), np.nan) for signal in signals}
    visible = np.zeros((len(table), table.horizon), bool)
    for episode, seed in enumerate(table.seeds):
        env.reset(seed=int(seed))
        learner.reset(int(seed))
        for signal in signals:
            signal.reset()
        for step in range(int(table.length[episode])):
            env.restore(table.snapshots[episode, step])
            clean = env.observe(clean=True)
            visible[episode, step] = env.disturbed and not np.array_equal(env.observe(), clean)
            prediction = learner.predict(clean, step)
            executed = env.simulator.data.ctrl.copy() if step else None
            for signal in signals:
                traces[signal.id][episode, step] = signal.update(clean, prediction, executed)
    return traces, visible
