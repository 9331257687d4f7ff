"""The thresholds marked on the page: each gives exactly the numbers that its method has in leaderboard.csv.

Those of the rules that were calibrated come from thresholds.csv, which a run writes beside its tables; the best ones
are found here. A folder of before that file existed has the thresholds that can be had from its other tables, as far
as they give the leaderboard's numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from safeswitch.handover.panel import Panel
from safeswitch.handover.table import Ints
from safeswitch.report.views import View
from safeswitch.scoring.metrics import CELL, signal_of
from safeswitch.scoring.thresholds import FILE, read_thresholds

SCORES = ("success", "autonomy", "return_mean", "false_alarms", "false_alarms_before_onset", "handovers")
"""Columns of the leaderboard that the page computes at any threshold."""

BEST = "best"


@dataclass(frozen=True)
class Mark:
    """A method that is a constant threshold.

    Attributes:
        method: its id.
        calibrated_on: as in the leaderboard.
        signal: that it looks at.
        thresholds: one per learner, in the order of the view's learners.
    """

    method: str
    calibrated_on: str
    signal: str
    thresholds: list[float]


def scores(panel: Panel, handover: Ints) -> dict[str, float]:
    """`SCORES` of handing the episodes of a panel over at the steps (E,), from whole numbers."""
    disturbed, horizon = panel.table.disturbed, panel.table.horizon
    handed = handover < horizon
    before = handed & (handover < panel.table.onset)
    return {
        "success": _share(panel.success(handover)),
        "autonomy": _share(panel.learner_steps(handover)) / horizon,
        "return_mean": float(panel.returns(handover).mean()),
        "false_alarms": _share(handed[~disturbed]),
        "false_alarms_before_onset": _share(before[disturbed]),
        "handovers": _share(handed),
    }


def _share(values: Any) -> float:
    return int(values.sum()) / len(values) if len(values) else math.nan


def agrees(written: float, exact: float) -> bool:
    """Whether `written` is `exact` rounded to the six significant digits of the leaderboard, either way on a tie."""
    if math.isnan(written) or math.isnan(exact):
        return math.isnan(written) and math.isnan(exact)
    if exact == 0:
        return written == 0
    unit = 10.0 ** (math.floor(math.log10(abs(exact))) - 5)
    return abs(written - exact) <= 0.5 * unit * (1 + 1e-6)


def marks(view: View, rows: pd.DataFrame, folder: Path) -> list[Mark]:
    """Marked thresholds of a view.

    Args:
        view: the cell and arming.
        rows: its rows of the leaderboard.
        folder: of the results.

    Raises:
        ValueError: a published threshold does not give the numbers of its row: they are of different runs.
    """
    path = folder / "tables" / view.tables.task.name / FILE
    published = read_thresholds(path) if path.is_file() else None
    found = {(row["method"], row["calibrated_on"]): row for _, row in rows.iterrows()}
    chosen = []
    chosen_by_rules = _recovered(view, found, folder) if published is None else _written(view, found, published)
    for mark in [*_best(view, found), *chosen_by_rules]:
        wrong = _disagreement(view, mark, found[mark.method, mark.calibrated_on])
        if not wrong:
            chosen.append(mark)
        elif published is not None:
            raise ValueError(
                f"{mark.method} in {view.cell}, armed at {view.protocol}: its thresholds give {wrong}; leaderboard.csv "
                f"and {path} are of different runs: run the benchmark again"
            )
    return chosen


def _disagreement(view: View, mark: Mark, row: Mapping[str, Any]) -> str:
    """What differs from the leaderboard, "" if nothing does."""
    exact = scores(view.pooled, view.handover(mark.signal, mark.thresholds))
    wrong = [name for name in SCORES if not agrees(float(row[name]), exact[name])]
    return ", ".join(f"{name} {exact[name]:.6g} and not {row[name]:.6g}" for name in wrong)


def _best(view: View, rows: Mapping[tuple[str, str], Any]) -> Iterator[Mark]:
    """`best@signal`: the hindsight optimum of each learner on these very episodes."""
    for method, on in rows:
        rule, signal = method.partition("@")[0], signal_of(method)
        if rule == BEST and signal in view.tables.signals:
            yield Mark(method, on, signal, [panel.best_threshold(signal)[0] for panel in view.panels.values()])


def _written(view: View, rows: Mapping[tuple[str, str], Any], published: pd.DataFrame) -> Iterator[Mark]:
    """Thresholds of methods that are the same threshold rule for every learner."""
    cell = (view.cell.task, view.cell.label, view.cell.severity, view.protocol)
    here = published[(published[CELL] == list(cell)).all(axis=1)]
    for (method, on), group in here.groupby(["method", "calibrated_on"], sort=True):
        values = dict(zip(group["learner"], group["threshold"], strict=True))
        signal = signal_of(str(method))
        if (method, on) in rows and signal in view.tables.signals and list(values) == view.tables.learners:
            yield Mark(str(method), str(on), signal, [float(value) for value in values.values()])


def _recovered(view: View, rows: Mapping[tuple[str, str], Any], folder: Path) -> Iterator[Mark]:
    """CEM's thresholds from cem_seeds.csv, absolute values from names; with one learner also the leaderboard."""
    seeds = pd.read_csv(folder / "cem_seeds.csv") if (folder / "cem_seeds.csv").is_file() else None
    for (method, on), row in rows.items():
        rule, signal = method.partition("@")[0], signal_of(method)
        if rule == BEST or signal not in view.tables.signals:
            continue
        values = _of_cem(view, method, on, seeds) if seeds is not None and rule.startswith("cem") else None
        if values is None and rule.startswith("fixed-") and _is_number(rule.removeprefix("fixed-")):
            values = [float(rule.removeprefix("fixed-"))] * len(view.tables.learners)
        if values is None and len(view.tables.learners) == 1 and np.isfinite(row["threshold"]):
            values = [float(row["threshold"])]
        if values is not None:
            yield Mark(method, on, signal, values)


def _of_cem(view: View, method: str, on: str, seeds: pd.DataFrame) -> list[float] | None:
    """Each learner's threshold of the run that was scored: CEM's seed there is the learner's."""
    paper = view.tables.task.paper_cell
    calibrated_on = str(paper) if on else str(view.cell)
    if calibrated_on != str(paper):
        return None
    here = seeds[(seeds[CELL] == [paper.task, paper.label, paper.severity, view.protocol]).all(axis=1)]
    own = here[(here["method"] == method) & (here["cem_seed"] == here["learner"])].set_index("learner")["threshold"]
    there = set(view.tables.learners) <= set(own.index)
    return [float(own[learner]) for learner in view.tables.learners] if there else None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
