"""left_out.csv, the headline: thresholds come from other disturbances than the one they are tested on.

Rules that learn from failures are calibrated on the other disturbances of the task (rows with `calibrated_on` =
`OTHERS`); rules that never see a failure have nothing to leave out. The episodes of all cells that have such rows count
alike and are resampled together over learners x episode seeds: the same seed in several cells is one seed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from safeswitch.scoring.cells import PairedEpisodes, cells, paired_episodes
from safeswitch.scoring.markdown import BLANK, interval, markdown_table, number
from safeswitch.scoring.metrics import OTHERS, TaskInfo, prepare
from safeswitch.scoring.stats import RESAMPLES, percentile_interval

KEY = ["task", "protocol", "method"]
RIVALS = {"cem": "cem@total", "grid": "grid@total"}
"""What every method is compared with, by the name in the columns."""
CEILING = "oracle-hindsight"
COLUMNS = [
    *KEY, "cells", "learner_seeds", "episodes", "return_mean", "return_lo", "return_hi", "success", "armed_autonomy",
    *(f"minus_{name}{bound}" for name in RIVALS for bound in ("", "_lo", "_hi")), "gap_closed",
]  # fmt: skip


def left_out_table(
    episodes: pd.DataFrame, infos: Mapping[str, TaskInfo], resamples: int = RESAMPLES, seed: int = 0
) -> pd.DataFrame:
    """One row per (task, protocol, method) that ran in every cell with rows of `OTHERS`; no row without such cells.

    Returns:
        The columns of `COLUMNS`. `minus_cem` is the method's return minus that of `cem@total`, `minus_grid` minus that
        of `grid@total`, both calibrated on other disturbances too, with paired intervals. `gap_closed` is the share of
        the way from `cem@total` to `oracle-hindsight`. `armed_autonomy` is the learner's share of T from the arming on.
    """
    frame = prepare(episodes, infos)
    groups: dict[tuple[str, str], list[PairedEpisodes]] = {}
    for cell, rows in cells(frame):
        if "calibrated_on" in rows and (rows["calibrated_on"] == OTHERS).any():
            groups.setdefault((cell[0], cell[3]), []).append(_whole_group(cell, _chosen(rows), infos[cell[0]].horizon))
    rows = [row for (task, protocol), parts in groups.items() for row in _rows(task, protocol, parts, resamples, seed)]
    return pd.DataFrame(rows, columns=COLUMNS).sort_values(KEY, kind="stable", ignore_index=True)


def _chosen(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of `OTHERS` where a method has them, its own where it has not."""
    moved = rows["calibrated_on"] == OTHERS
    kept = moved | ~rows["method"].isin(rows.loc[moved, "method"].unique())
    return rows[kept].drop(columns="calibrated_on")


def _whole_group(cell: tuple[Any, ...], rows: pd.DataFrame, horizon: int) -> PairedEpisodes:
    """The methods that ran on all episodes of a cell."""
    return max(paired_episodes(cell, rows, horizon), key=len)


def _rows(task: str, protocol: str, parts: list[PairedEpisodes], resamples: int, seed: int) -> list[dict[str, Any]]:
    group = _pooled((task, "left-out", 3, protocol), parts)
    weights = group.weights(resamples, seed)
    mean, means = group.mean_returns(group.once)[0], group.mean_returns(weights)
    lo, hi = percentile_interval(means)
    success, armed = group.mean_success(group.once)[0], group.armed.mean(axis=0) / group.horizon
    ceiling, paper = group.find(CEILING), group.find(RIVALS["cem"])
    rows = []
    for i, (method,) in enumerate(group.entries):
        row = {
            "task": task,
            "protocol": protocol,
            "method": method,
            "cells": len(parts),
            "learner_seeds": group.learners,
            "episodes": len(group),
            "return_mean": mean[i],
            "return_lo": lo[i],
            "return_hi": hi[i],
            "success": success[i],
            "armed_autonomy": armed[i],
        }
        for name, rival in RIVALS.items():
            other = group.find(rival)
            if other is not None:
                low, high = percentile_interval(means[:, i] - means[:, other])
                bounds = {f"minus_{name}_lo": float(low), f"minus_{name}_hi": float(high)}
                row |= {f"minus_{name}": mean[i] - mean[other], **bounds}
        if ceiling is not None and paper is not None and mean[ceiling] > mean[paper]:
            row["gap_closed"] = (mean[i] - mean[paper]) / (mean[ceiling] - mean[paper])
        rows.append(row)
    return rows


def _pooled(cell: tuple[Any, ...], parts: list[PairedEpisodes]) -> PairedEpisodes:
    """Episodes of several cells below one another, for the methods that ran in all of them."""
    entries = tuple(entry for entry in parts[0].entries if all(entry in part.entries for part in parts))
    columns = [[part.entries.index(entry) for entry in entries] for part in parts]
    return PairedEpisodes(
        cell,
        parts[0].horizon,
        np.concatenate([part.learner for part in parts]),
        np.concatenate([part.seed for part in parts]),
        entries,
        entries,
        np.concatenate([part.armed[:, index] for part, index in zip(parts, columns, strict=True)]),
        np.concatenate([part.success[:, index] for part, index in zip(parts, columns, strict=True)]),
    )


HEADER = ["method", "needs", "return", "success", "minus `cem@total`", "minus `grid@total`", "gap closed"]


def left_out_lines(table: pd.DataFrame, needs: Mapping[str, str], count: int = 12) -> list[str]:
    """Markdown of one task's rows: the best methods of each protocol, and those they are compared with.

    Args:
        table: rows of one task.
        needs: method -> what it needs, for readers.
        count: how many of the best are shown.
    """
    if table.empty:
        return []
    lines = ["### Headline: one disturbance left out", ""]
    lines += ["Thresholds are calibrated on the other disturbances; all disturbances, severity 3, count alike.", ""]
    for protocol, part in table.groupby("protocol", sort=True):
        ranked = part.sort_values(["return_mean", "method"], ascending=[False, True], kind="stable")
        shown = ranked[(np.arange(len(ranked)) < count) | ranked["method"].isin([*RIVALS.values(), "cem-vector"])]
        cells_, learners = int(part["cells"].max()), int(part["learner_seeds"].max())
        lines += [f"**Protocol `{protocol}`** ({cells_} disturbances, {learners} learners)", ""]
        body = [
            [
                f"`{row['method']}`",
                needs.get(row["method"], BLANK),
                interval(row, "return_mean", "return"),
                number(row["success"]),
                *(interval(row, f"minus_{name}", f"minus_{name}") for name in RIVALS),
                number(row["gap_closed"]),
            ]
            for row in shown.to_dict("records")
        ]
        lines += [*markdown_table(HEADER, body), ""]
    return lines
