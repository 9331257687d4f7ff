"""comparisons.csv: one method against every other on the same episodes, and who wins."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from safeswitch.names import unknown
from safeswitch.protocols import Array
from safeswitch.scoring.cells import Entry, PairedEpisodes, cells, paired_episodes
from safeswitch.scoring.metrics import CELL, TaskInfo, prepare, row_key
from safeswitch.scoring.stats import CONFIDENCE, RESAMPLES, holm, mcnemar, percentile_interval

COLUMNS = [
    *CELL, "reference", "method", "learner_seeds", "episodes", "return_diff", "return_diff_lo", "return_diff_hi",
    "success_diff", "success_diff_lo", "success_diff_hi", "only_reference", "only_method", "mcnemar_p", "mcnemar_holm",
    "learners_better", "learners_worse", "winner",
]  # fmt: skip
TIE = "tie"


def paired_comparisons(
    episodes: pd.DataFrame,
    infos: Mapping[str, TaskInfo],
    reference: str = "cem@total",
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> pd.DataFrame:
    """Compare `reference` with every other method, per task, cell and protocol, on the episodes both ran on.

    Returns:
        One row per (task, disturbance, severity, protocol, method). Differences are reference minus method, with the
        interval of the paired bootstrap over learners x episode seeds. `only_reference` and `only_method` count the
        episodes that only one of the two ended in success. McNemar's exact test is made within each learner, and its
        p-values are Holm-corrected over the methods of that cell, protocol and learner: with one learner they stand in
        `mcnemar_p` and `mcnemar_holm`, with several (blank there) `learners_better` and `learners_worse` count the
        learners for which the reference's success is significantly higher or lower at the 5 % level. `winner` goes by
        return: the reference, the method, or "tie" where the interval of the difference contains 0.

    Cells in which the reference did not run are left out.
    """
    frame = prepare(episodes, infos)
    methods = frame["method"].unique()
    if reference not in methods:
        raise unknown("reference method", reference, methods)
    rows = []
    for cell, part in cells(frame):
        for group in paired_episodes(cell, part, infos[cell[0]].horizon):
            rows += _compare(group, reference, resamples, seed)
    extra = [name for name in row_key(frame) if name == "calibrated_on"]
    table = pd.DataFrame(rows, columns=COLUMNS + extra)
    return table.sort_values([*CELL, "method", *extra], kind="stable", ignore_index=True)


def _compare(group: PairedEpisodes, reference: str, resamples: int, seed: int) -> list[dict[str, Any]]:
    pairs = [(group.find(reference, entry), group.entries.index(entry), entry) for entry in group.ranked]
    pairs = [(a, b, entry) for a, b, entry in pairs if a is not None and entry[0] != reference]
    if not pairs:
        return []
    columns = np.array([(a, b) for a, b, _ in pairs])
    weights = group.weights(resamples, seed)
    returns = _difference(group.mean_returns(group.once), group.mean_returns(weights), columns)
    success = _difference(group.mean_success(group.once), group.mean_success(weights), columns)
    tests = _mcnemar(group, columns)
    rows = []
    for i, (_, _, entry) in enumerate(pairs):
        row: dict[str, Any] = dict(zip(CELL, group.cell, strict=True)) | {"reference": reference}
        row |= dict(zip(("method", "calibrated_on"), entry, strict=False))
        row |= {"learner_seeds": group.learners, "episodes": len(group)}
        row |= {name: values[i] for name, values in zip(COLUMNS[8:11], returns, strict=True)}
        row |= {name: values[i] for name, values in zip(COLUMNS[11:14], success, strict=True)}
        row |= {name: values[i] for name, values in tests.items()}
        row["winner"] = _winner(reference, entry, row["return_diff_lo"], row["return_diff_hi"])
        rows.append(row)
    return rows


def _difference(once: Array, resampled: Array, columns: Array) -> tuple[Array, Array, Array]:
    """Difference reference - method of the columns (n, 2): estimate, lower and upper bound, each (n,)."""
    estimate = once[0, columns[:, 0]] - once[0, columns[:, 1]]
    return estimate, *percentile_interval(resampled[:, columns[:, 0]] - resampled[:, columns[:, 1]])


def _mcnemar(group: PairedEpisodes, columns: Array) -> dict[str, Array]:
    """Discordant pairs over all episodes, and the tests within each learner, Holm-corrected over the columns."""
    learners = np.unique(group.learner)
    only = np.zeros((len(learners), len(columns), 2), int)
    p = np.ones((len(learners), len(columns)))
    for i, learner in enumerate(learners):
        success = group.success[group.learner == learner]
        for j, (a, b) in enumerate(columns):
            test = mcnemar(success[:, a], success[:, b])
            only[i, j], p[i, j] = (test.only_a, test.only_b), test.p
    adjusted = np.array([holm(row) for row in p])
    significant = adjusted < 1 - CONFIDENCE
    single = len(learners) == 1
    blank = np.full(len(columns), np.nan)
    return {
        "only_reference": only[..., 0].sum(axis=0),
        "only_method": only[..., 1].sum(axis=0),
        "mcnemar_p": p[0] if single else blank,
        "mcnemar_holm": adjusted[0] if single else blank,
        "learners_better": (significant & (only[..., 0] > only[..., 1])).sum(axis=0),
        "learners_worse": (significant & (only[..., 0] < only[..., 1])).sum(axis=0),
    }


def _winner(reference: str, entry: Entry, lo: float, hi: float) -> str:
    if lo > 0:
        return reference
    return str(entry[0]) if hi < 0 else TIE
