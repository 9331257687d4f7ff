"""Puts the page together: template, style, scripts and the data of every task in one file."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

import pandas as pd

from safeswitch.files import atomic_write_text, load_json
from safeswitch.report.bundle import task_bundle
from safeswitch.report.pack import json_text, to_text
from safeswitch.scoring.leaderboard import read_csv
from safeswitch.suite import TASKS, Task

NAME = "report.html"

SCRIPTS = ("data.js", "svg.js", "board.js", "plane.js", "threshold.js", "player.js", "main.js")
"""Parts of the page's script, in this order."""


def write_report(folder: Path) -> Path:
    """Write `report.html` into a results folder, from its tables; returns the page's path.

    Raises:
        ValueError: there is no leaderboard, or its rows and the tables are of different runs.
    """
    board = folder / "leaderboard.csv"
    if not board.is_file():
        raise ValueError(f"no leaderboard.csv in {folder}: run `make bench` first, or name another folder of results")
    rows = read_csv(board)
    rows = rows.assign(calibrated_on=rows["calibrated_on"].astype(object).fillna("") if "calibrated_on" in rows else "")
    manifest = load_json(folder / "manifest.json") if (folder / "manifest.json").is_file() else {}
    tasks = [task for name, task in TASKS.items() if (rows["task"] == name).any()]
    if not tasks:
        raise ValueError(f"{board} has rows of none of the tasks {sorted(TASKS)}")
    path = folder / NAME
    atomic_write_text(path, _page([_data(folder, task, rows, manifest.get(task.name, {})) for task in tasks]))
    return path


def _data(folder: Path, task: Task, rows: pd.DataFrame, manifest: dict[str, Any]) -> str:
    """Two blocks of one task, which the page unpacks when the task is chosen."""
    bundle, pack = task_bundle(folder, task, rows[rows["task"] == task.name], manifest)
    kind = 'type="text/plain" hidden'
    return (
        f'<script {kind} data-task="{task.name}" data-part="json">{to_text(json_text(bundle).encode())}</script>\n'
        f'<script {kind} data-task="{task.name}" data-part="arrays">{to_text(pack.data())}</script>'
    )


def _page(data: list[str]) -> str:
    source = files(__package__) / "page"
    parts = {
        "STYLE": (source / "style.css").read_text(encoding="utf-8"),
        "DATA": "\n".join(data),
        "SCRIPT": "\n".join((source / name).read_text(encoding="utf-8") for name in SCRIPTS),
    }
    page = (source / "page.html").read_text(encoding="utf-8")
    for name, text in parts.items():
        page = page.replace(f"<!--{name}-->", text, 1)
    return page
