"""Intervals of every score of an episode, from the same resamples of learners x episode seeds as those of the return.

Shares and means are ratios of weighted sums of whole numbers, exact in whatever order they are taken; medians are those
of the resampled episodes. A share of 0 or 1 has no spread in any resample: it gets the Wilson interval for as many
trials as there are distinct episode seeds that the score applies to.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from safeswitch.protocols import Array
from safeswitch.scoring.metrics import CELL, MEDIANS, TaskInfo, episode_scores, row_key
from safeswitch.scoring.stats import percentile_interval, resample_weights, wilson
from safeswitch.seeding import stream

SHARES = [
    "recovery", "harm", "harm_disturbed", "harm_undisturbed", "timely", "missed", "false_alarms",
    "false_alarms_before_onset",
]  # fmt: skip
"""Yes or no, or a count, in each episode."""
SCORES = ["autonomy", *SHARES, "share_used", *MEDIANS]
COLUMNS = [f"{name}_{end}" for name in SCORES for end in ("lo", "hi")]


def score_intervals(frame: pd.DataFrame, infos: Mapping[str, TaskInfo], resamples: int, seed: int) -> pd.DataFrame:
    """Lower and upper bounds of `SCORES` per leaderboard row of prepared episodes (its key is the index)."""
    scores = episode_scores(frame, infos)
    rows, index = [], []
    for cell, part in frame.groupby(CELL, sort=True):
        draws: dict[bytes, Array] = {}
        key = row_key(frame)
        for entry, episodes in part.groupby(key, sort=True, dropna=False):
            units = episodes[["learner", "seed"]].to_numpy()
            if units.tobytes() not in draws:  # methods of a cell nearly always ran on the same episodes
                rng = stream(seed, "bootstrap", *cell)  # type: ignore[misc]
                draws[units.tobytes()] = resample_weights(units[:, 0], units[:, 1], rng, resamples)
            horizon = infos[cell[0]].horizon  # type: ignore[index]
            values = scores.loc[episodes.index]
            steps = episodes["learner_steps"].to_numpy(float)
            rows.append(_bounds(values, steps, horizon, units[:, 1], draws[units.tobytes()]))
            index.append(entry)
    return pd.DataFrame(rows, index=pd.MultiIndex.from_tuples(index, names=row_key(frame)))[COLUMNS]


def _bounds(scores: pd.DataFrame, steps: Array, horizon: int, seeds: Array, weights: Array) -> dict[str, Any]:
    """Bounds of one method from its episodes' scores and (B, n) weights."""
    shares = scores[SHARES].to_numpy(float)
    counts = np.column_stack([steps, shares])
    there = ~np.isnan(counts)
    with np.errstate(invalid="ignore", divide="ignore"):
        means = (weights @ np.where(there, counts, 0.0)) / (weights @ there.astype(float))
    means[:, 0] /= horizon
    lo, hi = percentile_interval(means)
    bounds = {"autonomy": (lo[0], hi[0])}
    for i, name in enumerate(SHARES, start=1):
        applies = there[:, i]
        value = counts[applies, i]
        if value.size and (value == value[0]).all() and value[0] in (0.0, 1.0):
            trials = len(np.unique(seeds[applies]))
            low, high = wilson(value[0] * trials, trials)
            bounds[name] = (float(low), float(high))
        else:
            bounds[name] = (lo[i], hi[i])
    bounds["share_used"] = _mean_bounds(scores["share_used"].to_numpy(float), weights)
    for name in MEDIANS:
        bounds[name] = _median_bounds(scores[name].to_numpy(float), weights)
    return {f"{name}_{end}": pair[i] for name, pair in bounds.items() for i, end in enumerate(("lo", "hi"))}


def _mean_bounds(values: Array, weights: Array) -> tuple[float, float]:
    """Bounds of a mean of fractions; einsum adds in one order, whatever the number of threads."""
    there = ~np.isnan(values)
    if not there.any():
        return float("nan"), float("nan")
    total = weights[:, there].sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        means = np.einsum("bn,n->b", weights[:, there], values[there]) / total
    lo, hi = percentile_interval(means)
    return float(lo), float(hi)


def _median_bounds(values: Array, weights: Array) -> tuple[float, float]:
    """Bounds of a median: of the episodes as often as each was drawn, the middle two averaged."""
    there = np.flatnonzero(~np.isnan(values))
    if not there.size:
        return float("nan"), float("nan")
    order = there[np.argsort(values[there], kind="stable")]
    cumulative = np.cumsum(weights[:, order], axis=1)
    half = cumulative[:, -1:] / 2
    lower, upper = np.argmax(cumulative >= half, axis=1), np.argmax(cumulative > half, axis=1)
    medians = (values[order][lower] + values[order][upper]) / 2
    medians[half[:, 0] == 0] = np.nan  # none of these episodes was drawn
    lo, hi = percentile_interval(medians)
    return float(lo), float(hi)
