"""failures.csv: what failed, and how. Early ends and solver failures count as failures in every score."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pandas as pd

from safeswitch.handover.outcomes import FAILURE, SOLVER_FAILURE, SUCCESS, UNKNOWN
from safeswitch.handover.table import HandoverTable
from safeswitch.suite import Cell

COLUMNS = [
    "task", "disturbance", "severity", "learner", "episodes", "learner_failures", "learner_early_ends", "outcomes",
    "expert_failures", "solver_failures", "solver_failure_seeds",
]  # fmt: skip


def failure_table(tables: Iterable[tuple[Cell, int, HandoverTable]]) -> pd.DataFrame:
    """One row per (cell, learner) of the test episodes.

    Args:
        tables: cell, learner seed, and the test episodes with the outcomes that were computed.

    Returns:
        The columns of `COLUMNS`: test episodes, those that the learner alone fails, those that it ends before T (a
        crash), handovers whose outcome was computed, those that the expert fails, those among them in which its solver
        found no finite plan at some step, and the seeds of these episodes, separated by spaces.
    """
    rows = []
    for cell, learner, table in tables:
        alone = np.arange(table.horizon + 1) >= table.length[:, None]
        known = np.where(alone, UNKNOWN, table.known())
        broken = (known == SOLVER_FAILURE).any(axis=1)
        rows.append(
            {
                "task": cell.task,
                "disturbance": cell.label,
                "severity": cell.severity,
                "learner": learner,
                "episodes": len(table),
                "learner_failures": int((~table.learner_success).sum()),
                "learner_early_ends": int((table.length < table.horizon).sum()),
                "outcomes": int((known >= FAILURE).sum()),
                "expert_failures": int(((known >= FAILURE) & (known != SUCCESS)).sum()),
                "solver_failures": int((known == SOLVER_FAILURE).sum()),
                "solver_failure_seeds": " ".join(map(str, table.seeds[broken].tolist())),
            }
        )
    return pd.DataFrame(rows, columns=COLUMNS)
