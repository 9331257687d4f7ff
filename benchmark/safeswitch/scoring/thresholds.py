"""Which methods are a constant threshold on one signal, and at which value for each learner.

A method counts as one if, on every test episode, it hands over exactly where `signal > threshold` does, and never gives
control back. That is checked and not declared, so a rule with patience, with another episode's trace or with memory is
never taken for one; nor is one that ran on some of the episodes only.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from safeswitch.files import atomic_write_text
from safeswitch.handover.panel import Panel
from safeswitch.scoring.metrics import CELL, signal_of

FILE = "thresholds.csv"
"""Name of the table, beside a task's handover tables."""

COLUMNS = [*CELL, "method", "calibrated_on", "learner", "threshold"]


def plain_thresholds(panel: Panel, rows: pd.DataFrame) -> pd.DataFrame:
    """Thresholds of those methods in `rows` that are a constant threshold on a signal of the panel.

    Args:
        panel: test episodes of one learner in one cell under one protocol.
        rows: episodes of methods on them, in the panel's order, with the columns of `metrics.COLUMNS`.

    Returns:
        One row per method with the columns of `COLUMNS`.
    """
    columns = [name for name in COLUMNS if name in rows]
    found = [group.iloc[0][columns] for group in _methods(rows) if _is_plain(panel, group)]
    return pd.DataFrame(found, columns=columns).reset_index(drop=True)


def _methods(rows: pd.DataFrame) -> Iterator[pd.DataFrame]:
    key = [name for name in ("method", "calibrated_on") if name in rows]
    for _, group in rows.groupby(key, sort=True, dropna=False):
        yield group


def _is_plain(panel: Panel, group: pd.DataFrame) -> bool:
    signal, threshold = signal_of(str(group["method"].iloc[0])), float(group["threshold"].iloc[0])
    if signal is None or signal not in panel.table.signals or np.isnan(threshold):
        return False
    if len(group) < len(panel):
        return False
    if not np.array_equal(group["seed"].to_numpy(), panel.table.seeds):
        raise ValueError("the rows of a method are not the episodes of the panel, in its order")
    handover = panel.handover_at(signal, np.array([threshold]))[0]
    driven = {"handover": handover, "learner_steps": panel.learner_steps(handover)}
    return all(np.array_equal(steps, group[name].to_numpy()) for name, steps in driven.items())


def write_thresholds(frame: pd.DataFrame, path: Path) -> Path:
    """Write the table with every digit: a rounded threshold may hand over elsewhere."""
    ordered = frame.sort_values([name for name in COLUMNS if name in frame and name != "threshold"], kind="stable")
    atomic_write_text(path, ordered.to_csv(index=False, lineterminator="\n"))
    return path


def read_thresholds(path: Path) -> pd.DataFrame:
    """Read what `write_thresholds` wrote, to the last bit."""
    frame = pd.read_csv(path, dtype={"threshold": str, "calibrated_on": str}, keep_default_na=False)
    return frame.assign(threshold=frame["threshold"].map(float))  # Python's own reading is exact
