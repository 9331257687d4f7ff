"""Exact counterfactuals: the outcome of handing over at every step of a learner-only trajectory.

For a latched rule an episode is the learner until the handover step s, then the expert. For one seed all thresholds
and all signals therefore share one learner-only trajectory, and the result depends on s alone: o(s) = 1 if handing
over at step s ends in success. The table is an evaluation device and not an approximation; a test proves that it
agrees with plain episodes to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from safeswitch.handover.episode import NeverSwitch, continue_with_expert, run_episode
from safeswitch.protocols import Array, Expert, Learner, Signal
from safeswitch.store import load_arrays, save_arrays

if TYPE_CHECKING:
    from safeswitch.tasks.base import TaskEnv

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class HandoverTable:
    """Learner-only trajectories of E episodes of one (cell, learner) and the outcome of every handover step.

    Attributes:
        seeds: (E,) episode seeds.
        onset: (E,) step t0, -1 where undisturbed.
        length: (E,) steps of the learner-only episode; < T after an early failure.
        learner_success: (E,) whether the learner alone succeeds.
        signals: signal id -> (E, T), NaN after an early end.
        outcome: (E, T + 1) o(s); the columns from `length` on hold `learner_success` (there is no handover).
    """

    seeds: Ints
    onset: Ints
    length: Ints
    learner_success: Bools
    signals: Mapping[str, Array]
    outcome: Bools

    def __len__(self) -> int:
        return len(self.seeds)

    @property
    def horizon(self) -> int:
        """Full length T in steps."""
        return self.outcome.shape[1] - 1

    @property
    def disturbed(self) -> Bools:
        """(E,) whether the episode has an onset."""
        return self.onset >= 0

    def take(self, index: NDArray[np.integer] | Bools) -> HandoverTable:
        """The table of the chosen episodes, in the order of `index`."""
        return HandoverTable(
            self.seeds[index],
            self.onset[index],
            self.length[index],
            self.learner_success[index],
            {name: trace[index] for name, trace in self.signals.items()},
            self.outcome[index],
        )

    def with_signal(self, name: str, trace: Array) -> HandoverTable:
        """The same table with the signal `name`, (E, T), added or replaced."""
        return replace(self, signals={**self.signals, name: trace})

    @cached_property
    def t_first(self) -> Array:
        """(E,) `t*_first`: last s with o = 1 on all of [t0, s]; NaN without such s, T if the learner alone succeeds."""
        good = self.outcome[:, :-1] | self._before_onset
        count = np.where(good.all(axis=1), self.horizon, np.argmin(good, axis=1))
        last = np.minimum(count, self.length) - 1
        return self._recoverable(np.where(last >= self.onset, last, -1))

    @cached_property
    def t_last(self) -> Array:
        """(E,) `t*_last`: largest s >= t0 with o(s) = 1; NaN if there is none, T if the learner alone succeeds."""
        steps = np.arange(self.horizon)
        good = self.outcome[:, :-1] & ~self._before_onset & (steps < self.length[:, None])
        return self._recoverable(np.where(good, steps, -1).max(axis=1))

    @property
    def _before_onset(self) -> Bools:
        return np.arange(self.horizon)[None, :] < self.onset[:, None]

    def _recoverable(self, last: Ints) -> Array:
        value = np.where(last >= 0, last, np.nan).astype(float)
        value[self.learner_success] = self.horizon
        value[~self.disturbed] = np.nan
        return value

    def save(self, path: Path) -> None:
        """Write as .npz without pickle."""
        names = list(self.signals)
        arrays = {f"signal:{name}": self.signals[name] for name in names}
        save_arrays(
            path,
            seeds=self.seeds,
            onset=self.onset,
            length=self.length,
            learner_success=self.learner_success,
            outcome=np.packbits(self.outcome, axis=1),
            horizon=np.array(self.horizon),
            **arrays,
        )

    @staticmethod
    def load(path: Path) -> HandoverTable:
        """Read what `save` wrote."""
        arrays = load_arrays(path)
        horizon = int(arrays["horizon"])
        outcome = np.unpackbits(arrays["outcome"], axis=1, count=horizon + 1).astype(bool)
        signals = {key.removeprefix("signal:"): value for key, value in arrays.items() if key.startswith("signal:")}
        return HandoverTable(
            arrays["seeds"], arrays["onset"], arrays["length"], arrays["learner_success"].astype(bool), signals, outcome
        )


def concatenate(tables: Sequence[HandoverTable]) -> HandoverTable:
    """One table of all episodes, for example the disturbed episodes and their undisturbed twins."""
    if not tables:
        raise ValueError("no tables to concatenate")
    names = set(tables[0].signals)
    for table in tables[1:]:
        if set(table.signals) != names:
            raise ValueError(f"tables hold different signals: {sorted(names)} and {sorted(table.signals)}")
    return HandoverTable(
        np.concatenate([table.seeds for table in tables]),
        np.concatenate([table.onset for table in tables]),
        np.concatenate([table.length for table in tables]),
        np.concatenate([table.learner_success for table in tables]),
        {name: np.concatenate([table.signals[name] for table in tables]) for name in tables[0].signals},
        np.concatenate([table.outcome for table in tables]),
    )


def record_table(
    env: TaskEnv,
    learner: Learner,
    signals: Sequence[Signal],
    expert: Expert,
    seeds: Sequence[int],
    on_episode: Callable[[], None] = lambda: None,
) -> HandoverTable:
    """Run the learner alone on each seed and then the expert from every step of each trajectory.

    The expert needs neither network nor observation, so the T continuations of an episode cost far less than T
    episodes.
    """
    rows = []
    for seed in seeds:
        episode = run_episode(env, learner, signals, NeverSwitch(), None, seed, record_snapshots=True)
        assert episode.snapshots is not None
        outcome = np.full(env.horizon + 1, episode.success)
        env.reset(seed=seed)
        for step in range(episode.length):
            env.restore(episode.snapshots[step])
            outcome[step] = continue_with_expert(env, expert)
        rows.append((episode, outcome))
        on_episode()
    return HandoverTable(
        np.array([episode.seed for episode, _ in rows], np.int64),
        np.array([episode.onset for episode, _ in rows], np.int64),
        np.array([episode.length for episode, _ in rows], np.int64),
        np.array([episode.success for episode, _ in rows], bool),
        {signal.id: np.stack([episode.signals[signal.id] for episode, _ in rows]) for signal in signals},
        np.stack([outcome for _, outcome in rows]),
    )
