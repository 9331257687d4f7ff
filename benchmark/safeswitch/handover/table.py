"""Exact counterfactuals: the outcome of handing over at every step of a learner-only trajectory.

For a latched rule an episode is the learner until the handover step s, then the expert. For one seed all thresholds
and all signals therefore share one learner-only trajectory, and the result depends on s alone: o(s) = 1 if handing
over at step s ends in success. The table is an evaluation device and not an approximation; a test proves that it
agrees with plain episodes to the last bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from safeswitch.files import load_arrays, save_arrays_compressed
from safeswitch.handover.episode import NeverSwitch, run_episode
from safeswitch.handover.outcomes import UNKNOWN, Continuation, Outcomes
from safeswitch.protocols import Array, Expert, Learner, Signal

if TYPE_CHECKING:
    from safeswitch.tasks.base import TaskEnv

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class HandoverTable:
    """Learner-only trajectories of E episodes of one learner, and the outcome of every handover step.

    Attributes:
        seeds: (E,) episode seeds.
        onset: (E,) step t0 of the learner-only trajectory, -1 where undisturbed, T where the disturbance never came
            into view on it.
        length: (E,) steps of the learner-only episode; < T after an early failure.
        learner_success: (E,) whether the learner alone succeeds.
        signals: signal id -> (E, T), NaN after an early end.
        sources: outcomes of the tables that this one was put together from; shared, so that nothing is computed twice.
        source: (E,) index into `sources`.
        row: (E,) the episode's row in its source.
        snapshots: (E, T + 1, ns), kept where a simulator is to resolve unknown outcomes.
    """

    seeds: Ints
    onset: Ints
    length: Ints
    learner_success: Bools
    signals: Mapping[str, Array]
    sources: tuple[Outcomes, ...]
    source: Ints
    row: Ints
    snapshots: Array | None = field(default=None, repr=False)

    def __len__(self) -> int:
        return len(self.seeds)

    @property
    def horizon(self) -> int:
        """Full length T in steps."""
        return self.sources[0].known.shape[1] - 1

    @property
    def disturbed(self) -> Bools:
        """(E,) whether the episode has an onset."""
        return self.onset >= 0

    def outcome(self, episodes: NDArray[np.integer], steps: NDArray[np.integer]) -> Bools:
        """o(s) for arrays of episodes and handover steps that broadcast; s = T: the learner alone."""
        episodes, steps = np.broadcast_arrays(episodes, steps)
        success = self.learner_success[episodes]
        open_ = steps < self.length[episodes]
        for index, outcomes in enumerate(self.sources):
            here = open_ & (self.source[episodes] == index)
            success[here] = outcomes(self.row[episodes[here]], steps[here])
        return success

    def complete(self) -> HandoverTable:
        """Compute every outcome that is not known yet."""
        self.outcome(np.arange(len(self))[:, None], np.arange(self.horizon + 1)[None, :])
        return self

    def known(self) -> NDArray[np.int8]:
        """(E, T + 1) what is known: 1 success, 0 failure, 2 failure of the expert's solver, -1 not computed.

        From `length` on it is what the learner does alone.
        """
        known = np.stack([self.sources[source].known[row] for source, row in zip(self.source, self.row, strict=True)])
        ended = np.arange(self.horizon + 1)[None, :] >= self.length[:, None]
        return np.where(ended, self.learner_success[:, None], known).astype(np.int8)

    def take(self, index: NDArray[np.integer] | Bools) -> HandoverTable:
        """The table of the chosen episodes, in the order of `index`."""
        return replace(
            self,
            seeds=self.seeds[index],
            onset=self.onset[index],
            length=self.length[index],
            learner_success=self.learner_success[index],
            signals={name: trace[index] for name, trace in self.signals.items()},
            source=self.source[index],
            row=self.row[index],
            snapshots=None,
        )

    def with_signal(self, name: str, trace: Array) -> HandoverTable:
        """The same table with the signal `name`, (E, T), added or replaced."""
        return replace(self, signals={**self.signals, name: trace})

    @cached_property
    def t_first(self) -> Array:
        """(E,) `t*_first`: last s with o = 1 on all of [t0, s]; NaN without such s, T if the learner alone succeeds."""
        return np.array([self._first(episode) for episode in range(len(self))])

    @cached_property
    def t_last(self) -> Array:
        """(E,) `t*_last`: largest s >= t0 with o(s) = 1; NaN if there is none, T if the learner alone succeeds."""
        return np.array([self._last(episode) for episode in range(len(self))])

    def _first(self, episode: int) -> float:
        onset, length = int(self.onset[episode]), int(self.length[episode])
        if onset < 0 or self.learner_success[episode]:
            return np.nan if onset < 0 else float(self.horizon)
        bad = (step for step in range(onset, length) if not self._single(episode, step))
        last = next(bad, length) - 1
        return float(last) if last >= onset else np.nan

    def _last(self, episode: int) -> float:
        onset, length = int(self.onset[episode]), int(self.length[episode])
        if onset < 0 or self.learner_success[episode]:
            return np.nan if onset < 0 else float(self.horizon)
        return float(next((step for step in range(length - 1, onset - 1, -1) if self._single(episode, step)), np.nan))

    def _single(self, episode: int, step: int) -> bool:
        return bool(self.outcome(np.array([episode]), np.array([step]))[0])

    def attach(self, env: TaskEnv, expert: Expert) -> HandoverTable:
        """Give the table a simulator, of its cell, that resolves unknown outcomes."""
        if self.snapshots is None or len(self.sources) != 1:
            raise ValueError("only a table as it was recorded or loaded, with its snapshots, can be given a simulator")
        self.sources[0].resolve = Continuation(env, expert, self.seeds, self.snapshots)
        return self

    def share(self, twin: HandoverTable) -> HandoverTable:
        """Take over the outcomes up to the onset that the undisturbed `twin` of the same seeds and learner knows.

        Up to there both are one trajectory. For a disturbance that is only seen the expert's continuation is the same
        too, to the last bit; for any other this would be wrong.
        """
        if not np.array_equal(self.seeds, twin.seeds) or twin.disturbed.any() or len(self.sources) != 1:
            raise ValueError("outcomes are shared with the undisturbed twin of a table as it was recorded: same seeds")
        known, steps = twin.known(), np.arange(self.horizon + 1)
        shared = (steps <= self.onset[:, None]) & (steps < self.length[:, None]) & (known != UNKNOWN)
        self.sources[0].known[shared] = known[shared]
        return self

    def save(self, path: Path, snapshots: bool = True) -> None:
        """Write as .npz without pickle; without snapshots it holds only the outcomes that are known by now."""
        save_arrays_compressed(
            path,
            seeds=self.seeds,
            onset=self.onset,
            length=self.length,
            learner_success=self.learner_success,
            outcome=self.known(),
            **({"snapshots": self.snapshots} if snapshots and self.snapshots is not None else {}),
            **{f"signal:{name}": trace for name, trace in self.signals.items()},
        )

    @staticmethod
    def load(path: Path) -> HandoverTable:
        """Read what `save` wrote."""
        arrays = load_arrays(path)
        return new_table(
            arrays["seeds"],
            arrays["onset"],
            arrays["length"],
            arrays["learner_success"],
            {key.removeprefix("signal:"): value for key, value in arrays.items() if key.startswith("signal:")},
            arrays["outcome"],
            arrays.get("snapshots"),
        )


def new_table(
    seeds: Ints,
    onset: Ints,
    length: Ints,
    learner_success: Bools,
    signals: Mapping[str, Array],
    outcome: NDArray[np.int8],
    snapshots: Array | None = None,
) -> HandoverTable:
    """A table with outcomes of its own, (E, T + 1), coded as in `Outcomes`."""
    count = len(seeds)
    source, row = np.zeros(count, np.int64), np.arange(count)
    outcomes = (Outcomes(np.array(outcome, np.int8)),)
    return HandoverTable(seeds, onset, length, learner_success, signals, outcomes, source, row, snapshots)


def join_chunks(tables: Sequence[HandoverTable]) -> HandoverTable:
    """Chunks of one cell as one recorded table, snapshots included."""
    stacked = concatenate(tables)
    snapshots = [table.snapshots for table in tables if table.snapshots is not None]
    return new_table(
        stacked.seeds,
        stacked.onset,
        stacked.length,
        stacked.learner_success,
        stacked.signals,
        stacked.known(),
        np.concatenate(snapshots) if len(snapshots) == len(tables) else None,
    )


def concatenate(tables: Sequence[HandoverTable]) -> HandoverTable:
    """One table of all episodes, for example the disturbed ones and their undisturbed twins; outcomes stay shared."""
    if not tables:
        raise ValueError("no tables to concatenate")
    names = set(tables[0].signals)
    for table in tables[1:]:
        if set(table.signals) != names:
            raise ValueError(f"tables hold different signals: {sorted(names)} and {sorted(table.signals)}")
    offsets = np.cumsum([0, *(len(table.sources) for table in tables)])
    return HandoverTable(
        np.concatenate([table.seeds for table in tables]),
        np.concatenate([table.onset for table in tables]),
        np.concatenate([table.length for table in tables]),
        np.concatenate([table.learner_success for table in tables]),
        {name: np.concatenate([table.signals[name] for table in tables]) for name in tables[0].signals},
        tuple(outcomes for table in tables for outcomes in table.sources),
        np.concatenate([table.source + offset for table, offset in zip(tables, offsets, strict=False)]),
        np.concatenate([table.row for table in tables]),
    )


def record_table(
    env: TaskEnv, learner: Learner, signals: Sequence[Signal], expert: Expert, seeds: Sequence[int]
) -> HandoverTable:
    """Run the learner alone on each seed; the outcomes are computed when they are asked for."""
    episodes = [run_episode(env, learner, signals, NeverSwitch(), None, seed, record_snapshots=True) for seed in seeds]
    snapshots = np.stack([episode.snapshots for episode in episodes if episode.snapshots is not None])
    table = new_table(
        np.array([episode.seed for episode in episodes], np.int64),
        np.array([episode.onset for episode in episodes], np.int64),
        np.array([episode.length for episode in episodes], np.int64),
        np.array([episode.success for episode in episodes], bool),
        {signal.id: np.stack([episode.signals[signal.id] for episode in episodes]) for signal in signals},
        np.full((len(episodes), env.horizon + 1), UNKNOWN, np.int8),
        snapshots,
    )
    return table.attach(env, expert)
