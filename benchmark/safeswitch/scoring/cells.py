"""The episodes of one cell and protocol as arrays, methods side by side on the same episodes, ready to be resampled."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from safeswitch.protocols import Array
from safeswitch.scoring.metrics import CELL, EPISODE, PHI, row_key
from safeswitch.scoring.stats import resample_weights
from safeswitch.seeding import stream

Entry = tuple[Any, ...]
"""A row within its cell: (method,), or (method, calibrated_on) where the episodes say it."""


@dataclass(frozen=True)
class PairedEpisodes:
    """n episodes and the M methods that ran on all of them.

    Attributes:
        cell: (task, disturbance, severity, protocol).
        horizon: T [steps].
        learner: (n,) learner seed of each episode.
        seed: (n,) episode seed; twins share learner and seed.
        entries: M rows, the index into the last axis of the arrays below.
        ranked: entries that ran on these episodes and no others (the rest is here as their reference).
        armed: (n, M) learner-driven steps from the arming step on, whole numbers.
        success: (n, M) 0 or 1.
    """

    cell: tuple[Any, ...]
    horizon: int
    learner: NDArray[np.int64]
    seed: NDArray[np.int64]
    entries: tuple[Entry, ...]
    ranked: tuple[Entry, ...]
    armed: Array
    success: Array

    def __len__(self) -> int:
        return len(self.learner)

    @property
    def learners(self) -> int:
        """Number of learner seeds."""
        return len(np.unique(self.learner))

    def find(self, method: str, like: Entry = ()) -> int | None:
        """Column of `method`: the one calibrated as `like` is, else the only one there is; None without either."""
        wanted = (method, *like[1:])
        if wanted in self.entries:
            return self.entries.index(wanted)
        named = [index for index, entry in enumerate(self.entries) if entry[0] == method]
        return named[0] if len(named) == 1 else None

    def mean_returns(self, weights: Array, phi: float = PHI) -> Array:
        """Mean return (B, M) under (B, n) weights.

        All sums are sums of whole numbers below 2^53 and therefore exact, in whatever order they are taken.
        """
        total = weights.sum(axis=1, keepdims=True)
        with np.errstate(invalid="ignore"):
            return (weights @ self.armed / self.horizon + phi * (weights @ self.success)) / total

    def mean_success(self, weights: Array) -> Array:
        """Mean success (B, M) under (B, n) weights."""
        with np.errstate(invalid="ignore"):
            return weights @ self.success / weights.sum(axis=1, keepdims=True)

    def weights(self, resamples: int, seed: int) -> Array:
        """(B, n) bootstrap weights; the draws of a cell are the same for all its methods, and in every run."""
        return resample_weights(self.learner, self.seed, stream(seed, "bootstrap", *self.cell), resamples)

    @property
    def once(self) -> Array:
        """(1, n) weights of the sample itself."""
        return np.ones((1, len(self)))


def cells(frame: pd.DataFrame) -> Iterator[tuple[tuple[Any, ...], pd.DataFrame]]:
    """Every (task, disturbance, severity, protocol) of prepared episodes and its rows, sorted."""
    yield from frame.groupby(CELL, sort=True)  # type: ignore[misc]


def paired_episodes(cell: tuple[Any, ...], rows: pd.DataFrame, horizon: int) -> Iterator[PairedEpisodes]:
    """Group the methods of a cell by the episodes they ran on (usually one group: all ran on the same)."""
    key = rows[row_key(rows)[len(CELL) :]]
    first = (key != key.shift()).any(axis=1)  # prepared episodes are sorted by method
    entries: list[Entry] = list(key[first].itertuples(index=False, name=None))
    column = first.cumsum().to_numpy() - 1
    units, unit = np.unique(rows[EPISODE].to_numpy(dtype=np.int64), axis=0, return_inverse=True)
    unit = unit.reshape(-1)
    armed = np.full((len(units), len(entries)), np.nan)
    success = np.full_like(armed, np.nan)
    armed[unit, column] = rows["armed_learner_steps"].to_numpy(float)
    success[unit, column] = rows["success"].to_numpy(float)
    present = ~np.isnan(armed)
    for pattern in np.unique(present, axis=1).T:
        usable = np.flatnonzero(present[pattern].all(axis=0))
        ranked = tuple(entries[i] for i in usable if np.array_equal(present[:, i], pattern))
        yield PairedEpisodes(
            cell,
            horizon,
            units[pattern, 0],
            units[pattern, 1],
            tuple(entries[i] for i in usable),
            ranked,
            armed[np.ix_(pattern, usable)],
            success[np.ix_(pattern, usable)],
        )
