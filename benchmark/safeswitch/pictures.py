"""Figures and video of one task: CEM's learning (the paper's Figure 1), one episode, thresholds, and a short film."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from safeswitch import registry, stages
from safeswitch.files import load_arrays, load_frame
from safeswitch.handover.episode import Episode, NeverSwitch, run_episode
from safeswitch.handover.panel import Calibration, Panel
from safeswitch.handover.table import HandoverTable
from safeswitch.protocols import Arming
from safeswitch.scoring import figures
from safeswitch.scoring.leaderboard import read_csv
from safeswitch.scoring.video import replay_frames, write_side_by_side
from safeswitch.store import Store

if TYPE_CHECKING:
    from safeswitch.stages import CellTables
    from safeswitch.suite import Cell, Task

SIGNAL = "total"
"""The paper's signal, of which the film and the episode's figure are."""

RULE = f"cem@{SIGNAL}"

LEARNING_SIGNALS = (SIGNAL, "epistemic")
"""Signals for which CEM's learning is drawn: the paper's, and the one that also works from the start."""


def draw(folder: Path, root: str, task: Task, learner: str, episodes: str, tables: CellTables, scores: str) -> None:
    """Draw everything into `folder`/figures, for the first learner in the paper's cell."""
    store, cell = Store(Path(root)), task.paper_cell
    target = folder / "figures"
    target.mkdir(parents=True)
    loaded = tables.load(store, task, cell)
    rows = load_frame(store.folder(episodes) / "episodes.npz")
    logs = load_arrays(store.folder(episodes) / "logs.npz")
    table = read_csv(store.folder(scores) / "leaderboard.csv")
    for protocol in stages.protocols_of(cell):
        calibration = stages.calibration_of(loaded, task, cell, protocol, seed=0)
        for signal in LEARNING_SIGNALS:
            _draw_cem(calibration.panel, rows, logs, protocol, cell, signal, target)
        _draw_sweep(stages.test_panel(loaded, cell, protocol), rows, protocol, cell, target)
        place = (cell.disturbance, cell.severity)
        figures.figure_plane(table, task.name, place, protocol, target / f"plane-{protocol}.png")
    calibration = stages.calibration_of(loaded, task, cell, "onset", seed=0)
    _draw_episode(task, cell, learner, loaded["test"], calibration, rows, target)


def _threshold(rows: pd.DataFrame, protocol: str, method: str = RULE) -> float:
    chosen = rows[(rows["protocol"] == protocol) & (rows["method"] == method)]
    return float(chosen["threshold"].iloc[0])


def _draw_cem(
    panel: Panel, rows: pd.DataFrame, logs: dict[str, Any], protocol: Arming, cell: Cell, signal: str, target: Path
) -> None:
    rule = f"cem@{signal}"
    prefix = f"{protocol}|{rule}|"
    log = {name.removeprefix(prefix): value for name, value in logs.items() if name.startswith(prefix)}
    figures.figure_cem(
        log,
        panel.margins(signal),
        _threshold(rows, protocol, rule),
        target / f"cem-{signal}-{protocol}.png",
        f"{rule} in {cell}, armed at {protocol}",
    )


def _draw_sweep(panel: Panel, rows: pd.DataFrame, protocol: Arming, cell: Cell, target: Path) -> None:
    thresholds = np.geomspace(0.01, 2.0, 300)
    returns = {
        name: panel.returns(panel.handover_at(name, thresholds)).mean(axis=1) for name in panel.table.signals
    }
    marks = {
        f"{rule}@{signal}": _threshold(rows, protocol, f"{rule}@{signal}")
        for signal in LEARNING_SIGNALS
        for rule in ("cem", "grid", "fixed-epmax95")
    }
    never = np.full(len(panel), panel.table.horizon)
    levels = {
        "learner": float(panel.returns(never).mean()),
        "expert": float(panel.returns(panel.executed(panel.arming_step)).mean()),
    }
    figures.figure_threshold_sweep(
        thresholds, returns, marks, target / f"thresholds-{protocol}.png", levels, f"{cell}, armed at {protocol}"
    )


def _draw_episode(
    task: Task,
    cell: Cell,
    learner: str,
    table: HandoverTable,
    calibration: Calibration,
    rows: pd.DataFrame,
    target: Path,
) -> None:
    """The first test episode that the learner fails and the rule saves: its signals, and a film of three drivers."""
    chosen = rows[(rows["protocol"] == "onset") & (rows["method"] == RULE)]
    saved = chosen[chosen["success"] & ~chosen["learner_success"]]
    row = (saved if len(saved) else chosen).iloc[0]
    threshold, seed = float(row["threshold"]), int(row["seed"])
    index = int(np.flatnonzero(table.seeds == seed)[0])
    env = stages.make_env(task, cell)
    drivers: dict[str, tuple[Any, Arming]] = {
        "learner": (NeverSwitch(), "start"),
        RULE: (registry.make_method(RULE).calibrate(calibration).rule, "onset"),
        "expert": (registry.make_method("expert").calibrate(calibration).rule, "start"),
    }
    runs = {name: _drive(task, env, learner, rule, seed, arming) for name, (rule, arming) in drivers.items()}
    figures.figure_episode(
        runs["learner"].signals,
        env.control_dt,
        int(table.onset[index]),
        runs[RULE].handover,
        float(table.t_first[index]),
        threshold,
        SIGNAL,
        target / "episode.png",
        f"{cell}, seed {seed}: signals of the learner alone",
    )
    film = stages.make_env(task, cell, render_mode="rgb_array")
    panels = [replay_frames(film, episode, name) for name, episode in runs.items()]
    write_side_by_side(panels, target / "episode.mp4", round(1 / env.control_dt))
    film.close()


def _drive(task: Task, env: Any, learner: str, rule: Any, seed: int, arming: Arming) -> Episode:
    signals = [registry.make_signal(name) for name in task.signals]
    driver = stages.load_learner(task, learner)
    return run_episode(env, driver, signals, rule, env.make_expert(), seed, arming, record_snapshots=True)
