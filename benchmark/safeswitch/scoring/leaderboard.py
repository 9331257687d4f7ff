"""leaderboard.csv and signals.csv: one row per (task, disturbance, severity, protocol, method), byte for byte stable.

The order of the episodes, the number of workers and the other tasks of a run do not change a single byte: episodes are
sorted first, the bootstrap of a cell has its own random stream and sums whole numbers only, and floats are written with
six significant digits.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from safeswitch.protocols import Array
from safeswitch.scoring.cells import PairedEpisodes, cells, paired_episodes
from safeswitch.scoring.intervals import COLUMNS as INTERVALS
from safeswitch.scoring.intervals import score_intervals
from safeswitch.scoring.metrics import (
    CELL,
    MIN_CONTEST,
    OTHER_PHIS,
    OTHER_PREVALENCES,
    REFERENCES,
    TaskInfo,
    prepare,
    row_key,
    signal_of,
    summary,
)
from safeswitch.scoring.stats import RESAMPLES, percentile_interval, wilson

KEY = [*CELL, "method"]
LEADING = [
    *KEY, "learner_seeds", "episodes", "return_mean", "return_lo", "return_hi", "skill", "skill_lo", "skill_hi",
    "success", "success_lo", "success_hi", "autonomy", "recovery", "harm", "timely", "margin_s", "delay_s",
    "false_alarms", "handovers", "threshold", "tuning_episodes",
]  # fmt: skip
FURTHER = [
    *(f"return_phi{phi:g}" for phi in OTHER_PHIS), *(f"return_prevalence{100 * p:g}" for p in OTHER_PREVALENCES),
    "return_learner_min", "return_learner_max", "success_learner_min", "success_learner_max", "success_interval",
    "contest_gap", "contest_share", "needing_handover", "missed", "share_used", "false_alarms_before_onset",
    "harm_disturbed", "harm_undisturbed", "expert_queries", *INTERVALS,
]  # fmt: skip


def leaderboard(
    episodes: pd.DataFrame, infos: Mapping[str, TaskInfo], resamples: int = RESAMPLES, seed: int = 0
) -> pd.DataFrame:
    """Score every method in every cell and protocol.

    Args:
        episodes: one row per (learner, episode, method), with the columns of `metrics.COLUMNS`.
        infos: task -> horizon and control step.
        resamples: bootstrap resamples per cell.
        seed: of the bootstrap.

    Returns:
        One row per method with the columns of `LEADING`, then `FURTHER` (docs/scores.md), sorted by key.
    """
    frame = prepare(episodes, infos)
    key = row_key(frame)
    intervals = [
        row
        for cell, rows in cells(frame)
        for group in paired_episodes(cell, rows, infos[cell[0]].horizon)
        for row in _intervals(group, resamples, seed)
    ]
    scored = pd.DataFrame([row[1] for row in intervals])
    scored.index = pd.MultiIndex.from_tuples([row[0] for row in intervals], names=key)
    table = summary(frame, infos).join(scored).join(score_intervals(frame, infos, resamples, seed)).reset_index()
    extra = [name for name in key if name not in LEADING]
    return table[LEADING + extra + FURTHER].sort_values(key, kind="stable", ignore_index=True)


def _intervals(group: PairedEpisodes, resamples: int, seed: int) -> list[tuple[tuple[Any, ...], dict[str, Any]]]:
    """Return, success and skill of the methods of a group, with intervals."""
    weights = group.weights(resamples, seed)
    mean, means = group.mean_returns(group.once)[0], group.mean_returns(weights)
    return_lo, return_hi = percentile_interval(means)
    success, success_lo, success_hi, kind = _success(group, weights)
    rows = []
    for entry in group.ranked:
        i = group.entries.index(entry)
        scores = {
            "learner_seeds": group.learners,
            "episodes": len(group),
            "return_mean": mean[i],
            "return_lo": return_lo[i],
            "return_hi": return_hi[i],
            "success": success[i],
            "success_lo": success_lo[i],
            "success_hi": success_hi[i],
            "success_interval": kind[i],
            **_skill(group, entry, mean, means),
        }
        rows.append(((*group.cell, *entry), scores))
    return rows


def _success(group: PairedEpisodes, weights: Array) -> tuple[Array, Array, Array, list[str]]:
    """Success (M,) with its interval, and which interval it is.

    Wilson within one learner, the bootstrap over several. Where all pooled episodes end alike the bootstrap has no
    spread at all; the interval is then Wilson's for as many trials as there are distinct episode seeds.
    """
    share = group.mean_success(group.once)[0]
    if group.learners == 1:
        return share, *wilson(group.success.sum(axis=0), len(group)), ["wilson"] * len(share)
    lo, hi = percentile_interval(group.mean_success(weights))
    seeds = len(np.unique(group.seed))
    flat = (share == 0) | (share == 1)
    flat_lo, flat_hi = wilson(np.where(flat, share, 0.0) * seeds, seeds)
    kind = ["wilson-seeds" if constant else "bootstrap" for constant in flat]
    return share, np.where(flat, flat_lo, lo), np.where(flat, flat_hi, hi), kind


def _skill(group: PairedEpisodes, entry: tuple[Any, ...], mean: Array, means: Array) -> dict[str, float]:
    """(R - R0) / (R_best - R0) on the episodes of the method itself, and the same in every resample."""
    nothing = dict.fromkeys(("skill", "skill_lo", "skill_hi", "contest_gap", "contest_share"), float("nan"))
    signal = signal_of(entry[0])
    best = group.find(f"best@{signal}", entry) if signal else None
    references = [index for name in REFERENCES if (index := group.find(name, entry)) is not None]
    if best is None or len(references) < len(REFERENCES):
        return nothing
    zero, zeros = mean[references].max(), means[:, references].max(axis=1)
    gap, gaps = float(mean[best] - zero), means[:, best] - zeros
    contest = gaps >= MIN_CONTEST
    scores = {**nothing, "contest_gap": gap, "contest_share": float(contest.mean())}
    if gap < MIN_CONTEST:
        return scores
    i = group.entries.index(entry)
    ratio = np.full(len(gaps), np.nan)  # a resample without contest has no skill, as a cell without contest has none
    ratio[contest] = (means[contest, i] - zeros[contest]) / gaps[contest]
    lo, hi = percentile_interval(ratio)
    return {**scores, "skill": float(mean[i] - zero) / gap, "skill_lo": float(lo), "skill_hi": float(hi)}


def format_number(value: Any) -> str:
    """A cell of the CSV: six significant digits, whole numbers in full, nothing for NaN. Reading it back is stable."""
    if isinstance(value, str):
        return value
    number = float(value)
    if np.isnan(number):
        return ""
    if np.isinf(number):
        return "inf" if number > 0 else "-inf"
    if number == 0:
        return "0"  # also -0.0
    if number == int(number) or abs(number) >= 1e5:
        return f"{number:.0f}"
    return f"{number:.6g}"


def csv_text(frame: pd.DataFrame) -> str:
    """The table as CSV text in the order of its rows."""
    return frame.map(format_number).to_csv(index=False, lineterminator="\n")


def write_csv(frame: pd.DataFrame, path: Path) -> Path:
    """Write leaderboard, signals or comparisons sorted by key; the file is there completely or not at all."""
    key = [name for name in (*KEY, "calibrated_on", "kind", "signal", "reference", "learner") if name in frame]
    write_text(path, csv_text(frame.sort_values(key, kind="stable")))
    return path


def read_csv(path: Path) -> pd.DataFrame:
    """Read a table of `write_csv`; writing it again gives the same bytes."""
    return pd.read_csv(path, keep_default_na=False, na_values=[""])


def merge_task_rows(old: Path | pd.DataFrame | None, new: pd.DataFrame) -> pd.DataFrame:
    """Replace in `old` all rows of the tasks that occur in `new`; rows of every other task stay as they are.

    Args:
        old: a table or the path of its CSV; None or a path that does not exist stands for an empty table.
        new: the rows of one or several tasks, complete.
    """
    if isinstance(old, Path):
        old = read_csv(old) if old.exists() else None
    if old is None:
        return new.reset_index(drop=True)
    columns = list(new.columns) + [name for name in old.columns if name not in new]
    kept = old[~old["task"].isin(new["task"].unique())]
    merged = new if kept.empty else pd.concat([kept, new], ignore_index=True)
    return merged.reindex(columns=columns).reset_index(drop=True)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text to `path` atomically, making its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    partial.write_text(text, encoding="utf-8", newline="\n")
    os.replace(partial, path)
