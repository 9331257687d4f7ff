"""What the page knows of a task: leaderboard rows, exact handover tables, marked thresholds, margins and films."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from safeswitch import registry
from safeswitch.files import load_json
from safeswitch.handover.outcomes import SUCCESS, UNKNOWN
from safeswitch.handover.panel import Panel
from safeswitch.handover.table import HandoverTable
from safeswitch.pictures import STORY
from safeswitch.report.marks import Mark, marks
from safeswitch.report.pack import Order, Pack, levels, records
from safeswitch.report.views import TaskTables, name_of, tables_in
from safeswitch.scoring_stages import protocols_of
from safeswitch.stages import make_env
from safeswitch.suite import Cell, Task
from safeswitch.tasks.disturbances import DISTURBANCES

NUMBERS = (
    "return_mean", "return_lo", "return_hi", "success", "success_lo", "success_hi", "autonomy", "skill", "skill_lo",
    "skill_hi", "recovery", "harm", "timely", "margin_s", "delay_s", "false_alarms", "threshold", "tuning_episodes",
)  # fmt: skip
"""Columns of the leaderboard that the page shows."""


def task_bundle(folder: Path, task: Task, rows: pd.DataFrame, manifest: dict[str, Any]) -> tuple[dict[str, Any], Pack]:
    """Everything about one task: a dictionary for JSON, and the arrays that it speaks of."""
    env = make_env(task, task.none_cell)
    bundle: dict[str, Any] = {
        "name": task.name,
        "id": task.env_id,
        "dt": env.control_dt,
        "made": {key: manifest[key] for key in ("commit", "profile", "made") if key in manifest},
        "cells": [_cell(cell, rows) for cell in task.cells if len(_rows_of(rows, cell))],
        "columns": list(NUMBERS),
        "methods": _methods(rows),
        "film": _film(folder, task),
    }
    env.close()
    pack, tables = Pack(), tables_in(folder / "tables" / task.name, task)
    if tables.tables:
        bundle["exact"] = _exact(folder, tables, rows, pack)
        bundle["arrays"] = pack.directory
    return bundle, pack


def _cell(cell: Cell, rows: pd.DataFrame) -> dict[str, Any]:
    """A cell and its leaderboard: for each protocol the method, what it was calibrated on, and `NUMBERS`."""
    boards = {}
    for protocol, group in _rows_of(rows, cell).groupby("protocol", sort=True):
        numbers = [[_plain(value) for value in row] for row in group[list(NUMBERS)].to_numpy(float)]
        boards[protocol] = {
            "learners": int(group["learner_seeds"].iloc[0]),
            "episodes": int(group["episodes"].max()),
            "rows": [
                [method, on, *row]
                for method, on, row in zip(group["method"], group["calibrated_on"], numbers, strict=True)
            ],
        }
    about = "" if cell.tag == "none" else DISTURBANCES[cell.disturbance].describe(cell.severity)
    return {
        "name": name_of(cell),
        "disturbance": cell.label,
        "severity": cell.severity,
        "tag": cell.tag,
        "about": about,
        "boards": boards,
    }


def _rows_of(rows: pd.DataFrame, cell: Cell) -> pd.DataFrame:
    return rows[(rows["disturbance"] == cell.label) & (rows["severity"] == cell.severity)]


def _plain(value: float) -> float | str | None:
    """A number for JSON."""
    if math.isnan(value):
        return None
    return value if math.isfinite(value) else str(value)


def _methods(rows: pd.DataFrame) -> dict[str, list[str]]:
    """Method -> what sets it apart: `privileged`, `returns` (gives control back)."""
    about = {}
    for name in sorted(rows["method"].unique()):
        try:
            method = registry.make_method(name)
        except ValueError:
            continue
        traits = ["privileged"] * ("privileged" in method.needs) + ["returns"] * (not method.latched)
        if traits:
            about[name] = traits
    return about


def _film(folder: Path, task: Task) -> dict[str, Any] | None:
    """Films of the task: the story of one episode, or the one video of all drivers; None where there is neither."""
    place = folder / "figures" / task.name
    base = f"figures/{task.name}"
    if (place / STORY).is_file():
        return {"base": base, **load_json(place / STORY)}
    return {"base": base, "all": "episode.mp4"} if (place / "episode.mp4").is_file() else None


def _exact(folder: Path, tables: TaskTables, rows: pd.DataFrame, pack: Pack) -> dict[str, Any]:
    """Tables of each cell, and marks and margins of each view, with what they compare mapped to float32."""
    marked = {}
    for view in tables.views():
        board = _rows_of(rows, view.cell)
        marked[view.cell, view.protocol] = (view, marks(view, board[board["protocol"] == view.protocol], folder))
    stacked = {cell: tables.stacked(cell) for cell in tables.cells}
    for cell, table in stacked.items():
        _add_table(pack, name_of(cell), table)
    signals = [_signal(name, stacked, marked, pack) for name in tables.signals]
    return {
        "horizon": tables.horizon,
        "learners": tables.learners,
        "none": name_of(tables.task.none_cell) if tables.task.none_cell in tables.cells else None,
        "cells": {name_of(cell): len(table) // len(tables.learners) for cell, table in stacked.items()},
        "views": [[name_of(view.cell), view.protocol] for view, _ in marked.values()],
        "signals": signals,
    }


def _add_table(pack: Pack, cell: str, table: HandoverTable) -> None:
    """Everything of a cell that does not depend on a signal; outcome 2 is unknown, `t*` is -1 where there is none."""
    pack.add(f"{cell}/seed", table.seeds, "int32")
    pack.add(f"{cell}/onset", table.onset, "int16")
    pack.add(f"{cell}/length", table.length, "int16")
    pack.add(f"{cell}/alone", table.learner_success, "uint8")
    known = table.known()
    pack.add(f"{cell}/outcome", np.where(known == UNKNOWN, 2, known == SUCCESS), "uint8")
    if (known[table.disturbed] >= 0).all():
        pack.add(f"{cell}/first", np.nan_to_num(table.t_first, nan=-1), "int16")
        pack.add(f"{cell}/last", np.nan_to_num(table.t_last, nan=-1), "int16")


def _signal(name: str, stacked: dict[Cell, HandoverTable], marked: Any, pack: Pack) -> dict[str, Any]:
    """One signal: its axis, traces, records under each arming, marks and margins."""
    runs = {}
    for cell, table in stacked.items():
        for protocol in protocols_of(cell):
            runs[name_of(cell), protocol] = records(Panel(table, protocol).running_max(name))
    views = {
        f"{name_of(cell)}/{protocol}": (
            [mark for mark in chosen if mark.signal == name],
            [_margins(panel, name) for panel in [view.pooled, *view.panels.values()]],
        )
        for (cell, protocol), (view, chosen) in marked.items()
    }
    compared = [values for _, _, values in runs.values()]
    compared += [np.array(mark.thresholds) for found, _ in views.values() for mark in found]
    compared += [np.array(limits) for _, margins in views.values() for limits in margins if limits]
    order = Order(np.concatenate(compared))
    for (place, arming), (counts, steps, values) in runs.items():
        pack.add(f"{place}/{arming}/{name}/count", counts, "uint8" if counts.max() < 256 else "int16")
        pack.add(f"{place}/{arming}/{name}/step", steps, "uint8" if steps.max() < 256 else "int16")
        pack.add(f"{place}/{arming}/{name}/value", order(values), "float32")
    axis = _axis(np.concatenate([table.signals[name].ravel() for table in stacked.values()]))
    for cell, table in stacked.items():
        pack.add(f"{name_of(cell)}/{name}/trace", levels(table.signals[name], *axis), "uint8")
    return {
        "name": name,
        "axis": axis,
        "marks": {view: [_mark(mark, order) for mark in found] for view, (found, _) in views.items()},
        "margins": {
            view: [limits and [_plain(float(limit)) for limit in order(limits)] for limits in margins]
            for view, (_, margins) in views.items()
        },
    }


def _mark(mark: Mark, order: Order) -> list[Any]:
    """Method, what it was calibrated on, threshold of each learner as it is and as it is compared."""
    return [
        mark.method,
        mark.calibrated_on,
        [_plain(value) for value in mark.thresholds],
        [_plain(float(value)) for value in order(mark.thresholds)],
    ]


def _margins(panel: Panel, signal: str) -> tuple[float, float] | None:
    """`Panel.margins`; None where there are none, or where too few outcomes were computed to tell."""
    try:
        low, high = panel.margins(signal)
    except LookupError:
        return None
    return None if math.isnan(low) else (low, high)


def _axis(values: Any) -> tuple[float, float, bool]:
    """Lowest and highest value, and whether the axis is logarithmic."""
    finite = values[np.isfinite(values)]
    low, high = float(finite.min()), float(finite.max())
    return low, high, low > 0
