"""The stages that score: methods on the test episodes of a cell, and signals on its frames and episodes.

As in `safeswitch.stages`, each is a job that is a pure function of its arguments.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from safeswitch import registry
from safeswitch.files import save_arrays, save_frame
from safeswitch.handover.episode import run_episode
from safeswitch.handover.panel import Calibration, Panel
from safeswitch.handover.published import armings_of, panel_of
from safeswitch.handover.shown import shown_traces
from safeswitch.handover.table import HandoverTable
from safeswitch.protocols import Arming
from safeswitch.scoring.metrics import OTHERS
from safeswitch.scoring.rows import episode_rows, latched_rows
from safeswitch.scoring.sightings import sightings
from safeswitch.scoring.signal_quality import SignalQuality, frame_quality, signal_quality
from safeswitch.stages import CellTables, Job, can_be_shown, concat, load_table, make_env, recorded_table, source_of
from safeswitch.store import LIBRARIES, Store
from safeswitch.suite import OPTIONAL, Cell, Task, methods
from safeswitch.trained import Trained

if TYPE_CHECKING:
    from safeswitch.protocols import Method

GIVE_BACK_SEEDS = 10
"""Test seeds per learner on which rules that give control back are driven where an episode is costly."""
SHOWN_CHUNKS = 1
"""Chunks of undisturbed episodes (1,600 states) on which a disturbance that is only seen is shown to the signals."""


def episodes_job(
    store: Store,
    task: Task,
    cell: Cell,
    trained: Trained,
    tables: CellTables,
    ids: tuple[str, ...],
    give_back: bool,
) -> Job:
    """Calibrate the methods `ids` and score them on the test episodes of one (learner, cell), under both armings."""
    settings = {"cell": str(cell), "learner_seed": trained.seed, "methods": list(ids), "give_back": give_back}
    if give_back and task.costly:
        settings["give_back_seeds"] = GIVE_BACK_SEEDS
    rules = {source_of("method", name.partition("@")[0]) for name in ids}
    code = ["safeswitch.handover.panel", "safeswitch.scoring.rows", *sorted(rules)]
    optional = [module.replace("_", "-") for name, (module, _) in OPTIONAL.items() if name in ids]
    key = store.key("episodes", settings, [*trained.keys, *tables.keys], code, [*LIBRARIES, *optional])
    arguments = (str(store.root), task, cell, trained, tables, ids, give_back)
    return Job("episodes", f"{cell} learner {trained.seed}", key, _score_episodes, arguments)


def methods_in(task: Task, cell: Cell) -> tuple[str, ...]:
    """Methods that run in a cell. Those that train a network run in the first three cells; for `simplex` see
    `Task.costly`.
    """
    spared = set() if cell in task.cells[:3] else set(OPTIONAL)
    if task.costly and not cell.complete("test"):
        spared.add("simplex")
    return tuple(name for name in methods(task.rule_signals) if name not in spared)


def _score_episodes(
    folder: Path,
    root: str,
    task: Task,
    cell: Cell,
    trained: Trained,
    tables: CellTables,
    ids: tuple[str, ...],
    give_back: bool,
) -> None:
    loaded = tables.load(Store(Path(root)), task, cell)
    others = tables.load_others(Store(Path(root)))
    own = "" if task.calibrated_on(cell) == cell else str(task.calibrated_on(cell))
    frames, logs = [], {}
    for protocol in protocols_of(cell):
        test = test_panel(loaded, cell, protocol)
        calibration = calibration_of(loaded, task, cell, protocol, trained.seed)
        for method_id in ids:
            method: Method = registry.make_method(method_id)
            if not method.latched and not (give_back and protocol == "start"):
                continue
            calibrated = method.calibrate(calibration)
            if calibrated.rule is None:
                continue
            if method.latched:
                rows = latched_rows(test, calibrated)
            else:
                some = test.take(np.isin(test.table.seeds, test.table.seeds[:GIVE_BACK_SEEDS])) if task.costly else test
                rows = plain_rows(task, cell, trained, some, method, calibrated.rule)
            frames.append(labelled(rows, cell, protocol, method_id, trained.seed, calibrated, own))
            logs.update({f"{protocol}|{method_id}|{name}": value for name, value in calibrated.log.items()})
        if others is not None:
            nominal = loaded["calibrate_nominal"]
            twins = nominal.take(np.searchsorted(nominal.seeds, others.seeds))  # seeds of a split are increasing
            left_out = Calibration(panel_of(others, twins, protocol), nominal, seed=trained.seed)
            frames += _left_out_rows(ids, cell, trained, test, left_out)
    save_frame(folder / "episodes.npz", concat(frames))
    save_arrays(folder / "logs.npz", **logs)
    loaded["test"].save(folder / "test.npz", snapshots=False)


def _left_out_rows(
    ids: tuple[str, ...], cell: Cell, trained: Trained, test: Panel, calibration: Calibration
) -> list[pd.DataFrame]:
    """Rows of the latched methods that learn from disturbed episodes, calibrated on those of other disturbances."""
    frames = []
    for method in map(registry.make_method, ids):
        learns = method.needs & {"failures", "rollouts"} and "privileged" not in method.needs
        calibrated = method.calibrate(calibration) if learns and method.latched else None
        if calibrated is not None and calibrated.rule is not None:
            rows = latched_rows(test, calibrated)
            frames.append(labelled(rows, cell, test.arming, method.id, trained.seed, calibrated, OTHERS))
    return frames


def protocols_of(cell: Cell) -> tuple[Arming, ...]:
    """Armings under which a cell is scored."""
    return armings_of(cell.label)


def test_panel(loaded: dict[str, HandoverTable], cell: Cell, protocol: Arming) -> Panel:
    """Test episodes of a cell under an arming."""
    nominal = None if cell.tag == "none" else loaded["test_nominal"]
    return panel_of(loaded["test"], nominal, protocol)


def calibration_of(
    loaded: dict[str, HandoverTable], task: Task, cell: Cell, protocol: Arming, seed: int
) -> Calibration:
    """Calibrate episodes of a cell under an arming."""
    nominal = loaded["calibrate_nominal"]
    return Calibration(panel_of(loaded["calibrate"], nominal, protocol), nominal, seed=seed)


def plain_rows(task: Task, cell: Cell, trained: Trained, test: Panel, method: Method, rule: Any) -> pd.DataFrame:
    """Rules that give control back have no table: drive the same episodes."""
    driver, signals = trained.learner(task), trained.signals(task, getattr(rule, "reads", None))
    envs = {True: make_env(task, cell), False: make_env(task, task.undisturbed(cell))}
    experts = {kind: env.make_expert() for kind, env in envs.items()}
    advisers = {kind: env.make_expert() if "expert-queries" in method.needs else None for kind, env in envs.items()}
    episodes = [
        run_episode(envs[kind], driver, signals, rule, experts[kind], seed, test.arming, adviser=advisers[kind])
        for seed, kind in zip(test.table.seeds.tolist(), test.table.disturbed.tolist(), strict=True)
    ]
    for env in envs.values():
        env.close()
    return episode_rows(test, episodes)


def labelled(
    rows: pd.DataFrame, cell: Cell, protocol: str, method_id: str, learner_seed: int, calibrated: Any, on: str
) -> pd.DataFrame:
    """Rows of `scoring.rows` with the columns that say what they are rows of."""
    return rows.assign(
        task=cell.task,
        disturbance=cell.label,
        severity=cell.severity,
        protocol=protocol,
        method=method_id,
        learner=learner_seed,
        threshold=calibrated.threshold,
        tuning_episodes=calibrated.tuning_episodes,
        expert_queries=calibrated.expert_queries,
        calibrated_on=on,
    )


def signals_job(
    store: Store, task: Task, cell: Cell, trained: Trained, disturbed: tuple[str, ...], twins: tuple[str, ...]
) -> Job:
    """Signal quality of one (learner, cell), from tables of test episodes (or none) and of their undisturbed twins.

    A disturbance that is only seen, or placed, is judged on the twins' states, with and without it in view; then no
    disturbed episode is needed for the frames.
    """
    settings = {
        "cell": str(cell),
        "learner_seed": trained.seed,
        "signals": list(task.signals),
        "shown_chunks": SHOWN_CHUNKS,
    }
    scoring = ["safeswitch.scoring.signal_quality", "safeswitch.scoring.sightings"]
    code = [*scoring, "safeswitch.handover.table", "safeswitch.handover.shown"]
    key = store.key("signals", settings, [*trained.keys, *disturbed, *twins], code)
    arguments = (str(store.root), task, cell, trained, disturbed, twins)
    return Job("signals", f"{cell} learner {trained.seed}", key, _score_signals, arguments)


def _score_signals(
    folder: Path,
    root: str,
    task: Task,
    cell: Cell,
    trained: Trained,
    disturbed_keys: tuple[str, ...],
    twin_keys: tuple[str, ...],
) -> None:
    store = Store(Path(root))
    twins = recorded_table(store, twin_keys)
    by_signal: dict[str, SignalQuality] = {}
    if disturbed_keys:
        disturbed = load_table(store, task, cell, disturbed_keys)
        about = (disturbed.onset, disturbed.t_first, disturbed.learner_success)
        for signal in task.signals:
            by_signal[signal] = signal_quality(disturbed.signals[signal], twins.signals[signal], *about)
    about_cell = {"task": cell.task, "disturbance": cell.label, "severity": cell.severity, "learner": trained.seed}
    if can_be_shown(cell):
        env = make_env(task, cell)
        states = recorded_table(store, twin_keys[:SHOWN_CHUNKS])
        shown = shown_traces(env, trained.learner(task), trained.signals(task), states)
        env.close()
        if np.isfinite(shown.distance).any():
            seen = sightings(shown, dict(states.signals), task.signals).assign(**about_cell)
            save_frame(folder / "sightings.npz", seen)
        for signal in task.signals:
            frames = frame_quality(shown.traces[signal], states.signals[signal], shown.judged)
            before = by_signal.get(signal, frames)
            by_signal[signal] = replace(frames, episode_auroc=before.episode_auroc)
    rows = [{"signal": signal, **asdict(quality)} for signal, quality in by_signal.items()]
    save_frame(folder / "signals.npz", pd.DataFrame(rows).assign(**about_cell))
