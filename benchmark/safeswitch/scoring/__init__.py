"""Scores, intervals and tables. `safeswitch.scoring.figures` is separate: it alone needs matplotlib."""

from __future__ import annotations

from safeswitch.scoring.comparisons import paired_comparisons
from safeswitch.scoring.leaderboard import csv_text, leaderboard, merge_task_rows, read_csv, write_csv
from safeswitch.scoring.markdown import write_markdown
from safeswitch.scoring.metrics import TaskInfo
from safeswitch.scoring.signal_quality import SignalQuality, auroc, fpr_at_tpr, signal_quality, signal_table

__all__ = [
    "SignalQuality",
    "TaskInfo",
    "auroc",
    "csv_text",
    "fpr_at_tpr",
    "leaderboard",
    "merge_task_rows",
    "paired_comparisons",
    "read_csv",
    "signal_quality",
    "signal_table",
    "write_csv",
    "write_markdown",
]
