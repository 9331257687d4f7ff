"""o(s), the outcome of handing over at step s: computed when it is asked for, and remembered.

A continuation starts from a snapshot of the learner-only trajectory and needs neither network nor observation. One
that starts before t0 still meets the disturbance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from safeswitch.handover.episode import continue_with_expert, solver_failures
from safeswitch.protocols import Array, Expert

if TYPE_CHECKING:
    from safeswitch.tasks.base import TaskEnv

UNKNOWN, FAILURE, SUCCESS, SOLVER_FAILURE = -1, 0, 1, 2
"""What stands in a table. The last is a failure too, kept apart so that it can be listed: at a step or more the expert
found no finite plan."""


class Continuation:
    """Lets the expert drive recorded episodes from any step to the end.

    Args:
        env: the unwrapped task in the cell of the episodes.
        expert: plans from scratch at the handover, so that its plan is a function of the state.
        seeds: (E,) episode seeds.
        snapshots: (E, T + 1, ns) snapshots of the learner-only trajectories.
    """

    def __init__(self, env: TaskEnv, expert: Expert, seeds: NDArray[np.int64], snapshots: Array):
        self.env, self.expert, self.seeds, self.snapshots = env, expert, seeds, snapshots
        self._current = -1

    def __call__(self, episode: int, step: int) -> int:
        """o(step) of an episode: `SUCCESS`, `FAILURE` or `SOLVER_FAILURE`."""
        if episode != self._current:
            self.env.reset(seed=int(self.seeds[episode]))
            self._current = episode
        self.env.restore(self.snapshots[episode, step])
        before = solver_failures(self.expert)
        if continue_with_expert(self.env, self.expert):
            return SUCCESS
        return FAILURE if solver_failures(self.expert) == before else SOLVER_FAILURE


@dataclass
class Outcomes:
    """What is known of o(s) for E episodes.

    Attributes:
        known: (E, T + 1) int8: `SUCCESS`, `FAILURE`, `SOLVER_FAILURE`, or `UNKNOWN`: not computed yet.
        resolve: computes one entry; None where no simulator is at hand.
    """

    known: NDArray[np.int8]
    resolve: Callable[[int, int], int] | None = None

    def __call__(self, episodes: NDArray[np.int64], steps: NDArray[np.int64]) -> NDArray[np.bool_]:
        """o(s) for pairs (n,), (n,) of episode and handover step.

        Raises:
            LookupError: an outcome is unknown and no simulator is at hand.
        """
        values = self.known[episodes, steps]
        missing = np.flatnonzero(values == UNKNOWN)
        if missing.size:
            if self.resolve is None:
                raise LookupError(
                    f"{missing.size} handover outcomes are not in the table, and it was loaded without a simulator"
                )
            for episode, step in np.unique(np.stack([episodes[missing], steps[missing]]), axis=1).T:
                self.known[episode, step] = self.resolve(int(episode), int(step))
            values = self.known[episodes, steps]
        return values == SUCCESS
