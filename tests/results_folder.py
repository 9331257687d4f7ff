"""A results folder as a run leaves it, from arbitrary handover tables: calibrated, scored and written in seconds."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from safeswitch import registry, suite
from safeswitch.handover.panel import Calibration
from safeswitch.handover.published import file_name
from safeswitch.report.views import tables_in
from safeswitch.scoring import TaskInfo, leaderboard, write_csv
from safeswitch.scoring.rows import latched_rows
from safeswitch.scoring.thresholds import FILE, plain_thresholds, write_thresholds
from safeswitch.scoring_stages import labelled
from synthetic import HORIZON, random_table

TASK = suite.task("cart-pole")
SIGNALS = ("total", "epistemic")
METHODS = (
    "learner", "expert", "timer", "oracle-hindsight", "shuffled@total", "random",
    *(f"{rule}@{signal}" for rule in ("best", "cem", "fixed-q95", "fixed-q99", "grid") for signal in SIGNALS),
)  # fmt: skip


def write_results(folder: Path, learners: int = 2, cells: int = 3, episodes: int = 14) -> Path:
    """Tables, thresholds and leaderboard of the cart-pole's first cells."""
    chosen, place = TASK.cells[:cells], folder / "tables" / TASK.name
    place.mkdir(parents=True)
    for learner in range(learners):
        for index, cell in enumerate(chosen):
            table = random_table(10 * learner + index, episodes, cell != TASK.none_cell, SIGNALS)
            table.save(place / file_name(cell.label, cell.severity, "test", learner))
    rows, plain = [], []
    for view in tables_in(place, TASK).views():
        for learner, panel in view.panels.items():
            nominal = (
                panel.table.take(~panel.table.disturbed)
                if view.protocol == "start"
                else random_table(99, 9, False, SIGNALS)
            )
            frames = []
            for method in METHODS:
                calibrated = registry.make_method(method).calibrate(Calibration(panel, nominal, seed=learner))
                frames.append(
                    labelled(latched_rows(panel, calibrated), view.cell, view.protocol, method, learner, calibrated, "")
                )
            rows += frames
            plain.append(plain_thresholds(panel, pd.concat(frames, ignore_index=True)))
    infos = {TASK.name: TaskInfo(HORIZON, 0.06)}
    write_csv(leaderboard(pd.concat(rows, ignore_index=True), infos, resamples=50), folder / "leaderboard.csv")
    write_thresholds(pd.concat(plain, ignore_index=True), place / FILE)
    return folder
