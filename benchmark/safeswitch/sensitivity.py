"""sensitivity.csv and latency.csv: how much results hang on what was chosen, and what a decision takes.

Everything here is about the paper's cell. Thresholds are learned again with one thing changed: how much CEM draws, how
many calibrate episodes there are, what a success is worth, and, with the episodes driven anew, how many dropout samples
K a decision takes.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from safeswitch import registry
from safeswitch.files import load_frame, save_frame
from safeswitch.handover.episode import DEVIATION
from safeswitch.handover.panel import Calibration, Panel
from safeswitch.handover.table import HandoverTable, record_table
from safeswitch.scoring.leaderboard import leaderboard
from safeswitch.scoring.metrics import REFERENCES, TaskInfo, signal_of
from safeswitch.scoring.rows import latched_rows
from safeswitch.scoring_stages import calibration_of, labelled, methods_in, protocols_of, test_panel
from safeswitch.stages import HANDOVER, PHYSICS, CellTables, Job, concat, make_env, source_of
from safeswitch.store import Store
from safeswitch.suite import Cell, Profile, Task
from safeswitch.trained import Trained

SIGNAL = "total"
"""The paper's signal, on which everything is varied."""
REFERENCE_METHODS = (*REFERENCES, f"best@{SIGNAL}")
"""What skill is measured against; they stand beside every variant."""
CEM_CHANGES: Mapping[str, tuple[dict[str, int], ...]] = {
    "candidates": tuple({"candidates": n, "elites": n // 2} for n in (4, 8, 16, 32, 64)),
    "iterations": tuple({"iterations": n, "average": min(n, 15)} for n in (5, 10, 20, 40, 80)),
    "shared-episodes": tuple({"episodes": n} for n in (2, 4, 8, 16, 32)),
}
"""Changes of `cem@total`, by the field that is varied; its name in the table and the value are those of the first."""
LEARNING = ("cem@total", "grid@total", "random-search@total", "cem-vector", "fixed-q95@total", "conformal@total")
"""Methods whose return is shown against the number of calibrate episodes, the cost of learning."""
COUNTS = (5, 10, 20, 40)
"""Calibrate episodes of each kind, disturbed and undisturbed; as many as there are at most."""
PHIS = (1.0, 2.0, 20.0, 100.0)
"""Rewards of success for which a threshold is learned; the headline's stands in the other rows."""
SAMPLES = (5, 10, 30, 100)
"""Dropout samples K of a decision."""
DRIVEN = 20
"""Episodes of each kind and split that are driven anew for each K."""
TIMED = 2
"""Episodes on which decisions are timed."""
KEY = ["task", "disturbance", "severity", "protocol", "parameter", "value", "method"]
SCORES = [
    "learner_seeds", "episodes", "return_mean", "return_lo", "return_hi", "skill", "skill_lo", "skill_hi",
    "success", "success_lo", "success_hi", "autonomy", "threshold", "tuning_episodes",
]  # fmt: skip


def varied_job(store: Store, task: Task, trained: Trained, tables: CellTables) -> Job:
    """Thresholds of one learner, learned with one thing changed, on the paper's cell."""
    rules = {source_of("method", method.partition("@")[0]) for method in (*LEARNING, *REFERENCE_METHODS)}
    code = ["safeswitch.handover.panel", "safeswitch.scoring.rows", "safeswitch.sensitivity", *sorted(rules)]
    key = store.key("varied", {"task": task.name, "learner": trained.seed}, [*trained.keys, *tables.keys], code)
    return Job("varied", f"{task.name} learner {trained.seed}", key, _vary, (str(store.root), task, trained, tables))


def _vary(folder: Path, root: str, task: Task, trained: Trained, tables: CellTables) -> None:
    cell, frames = task.paper_cell, []
    loaded = tables.load(Store(Path(root)), task, cell)
    for protocol in protocols_of(cell):
        test = test_panel(loaded, cell, protocol)
        calibration = calibration_of(loaded, task, cell, protocol, trained.seed)
        for parameter, value, method, given in [*_references(), *_variants(calibration)]:
            rows = _rows(test, given or calibration, cell, trained, method)
            frames.append(rows.assign(parameter=parameter, value=value))
    save_frame(folder / "varied.npz", concat(frames))


def _references() -> Iterator[tuple[str, float, Any, Calibration | None]]:
    for name in REFERENCE_METHODS:
        yield "", 0.0, registry.make_method(name), None


def _variants(calibration: Calibration) -> Iterator[tuple[str, float, Any, Calibration | None]]:
    """Parameter, its value, the method, and what it is calibrated on if not the whole."""
    cem = registry.find("method", "cem")
    for parameter, changes in CEM_CHANGES.items():
        for each in changes:
            yield parameter, float(next(iter(each.values()))), cem(SIGNAL, **each), None
    for count in COUNTS:
        for name in LEARNING:
            yield "calibrate-episodes", float(count), registry.make_method(name), first_episodes(calibration, count)
    for phi in PHIS:
        yield "phi", phi, cem(SIGNAL), replace(calibration, phi=phi)


def first_episodes(calibration: Calibration, count: int) -> Calibration:
    """The calibration with the first `count` seeds of each kind alone."""
    nominal = calibration.nominal.take(np.arange(min(count, len(calibration.nominal))))
    kept = np.isin(calibration.panel.table.seeds, nominal.seeds)
    return replace(calibration, panel=calibration.panel.take(kept), nominal=nominal)


def _rows(test: Panel, calibration: Calibration, cell: Cell, trained: Trained, method: Any) -> pd.DataFrame:
    calibrated = method.calibrate(calibration)
    return labelled(latched_rows(test, calibrated), cell, test.arming, method.id, trained.seed, calibrated, "")


def samples_job(store: Store, task: Task, profile: Profile, trained: Trained, samples: int) -> Job:
    """Episodes of the paper's cell, and their twins, driven by one learner with K = `samples`, and `cem@total` on them.

    The learner has to say its network, encoding and configuration, as those of this suite do.
    """
    seeds = {split: profile.seeds_of(task, task.paper_cell, split)[:DRIVEN] for split in ("calibrate", "test")}
    rules = {source_of("method", method.partition("@")[0]) for method in ("cem", *REFERENCE_METHODS)}
    code = [*PHYSICS, *task.code(), *HANDOVER, source_of("learner", task.learner), source_of("signal", SIGNAL)]
    code += ["safeswitch.handover.panel", "safeswitch.scoring.rows", "safeswitch.sensitivity", *sorted(rules)]
    settings = {"task": task.name, "learner": trained.seed, "samples": samples, "seeds": seeds}
    key = store.key("samples", settings, [trained.key], code)
    label = f"{task.name} learner {trained.seed}, K = {samples}"
    return Job("samples", label, key, _drive, (task, trained, seeds, samples))


def _drive(folder: Path, task: Task, trained: Trained, seeds: Mapping[str, list[int]], samples: int) -> None:
    given = trained.learner(task)
    learner = type(given)(given.model, given.encoding, replace(given.config, samples=samples))
    tables: dict[str, HandoverTable] = {}
    for name, cell in (("nominal", task.none_cell), ("", task.paper_cell)):
        for split, its_seeds in seeds.items():
            env = make_env(task, cell)
            signals = [registry.make_signal(SIGNAL)]
            tables[split + name] = record_table(env, learner, signals, env.make_expert(), its_seeds)
    loaded = {
        "calibrate": tables["calibrate"],
        "calibrate_nominal": tables["calibratenominal"],
        "test": tables["test"],
        "test_nominal": tables["testnominal"],
    }
    cell, frames = task.paper_cell, []
    for protocol in protocols_of(cell):
        test = test_panel(loaded, cell, protocol)
        calibration = calibration_of(loaded, task, cell, protocol, trained.seed)
        for name in (*REFERENCE_METHODS, f"cem@{SIGNAL}"):
            frames.append(_rows(test, calibration, cell, trained, registry.make_method(name)))
    save_frame(folder / "varied.npz", concat(frames).assign(parameter="dropout-samples", value=float(samples)))


def sensitivity_table(store: Store, task: Task, info: TaskInfo, jobs: list[Job]) -> pd.DataFrame:
    """One row per (protocol, parameter, value, method) with the leaderboard's scores and their intervals."""
    rows = concat([load_frame(store.folder(job.key) / "varied.npz") for job in jobs])
    shared = rows[rows["parameter"] == ""]
    found = []
    for (parameter, value), part in rows[rows["parameter"] != ""].groupby(["parameter", "value"], sort=True):
        frame = part if set(REFERENCE_METHODS) <= set(part["method"]) else pd.concat([shared, part])
        scored = leaderboard(frame.drop(columns=["parameter", "value"]), {task.name: info})
        found.append(scored[~scored["method"].isin(REFERENCE_METHODS)].assign(parameter=parameter, value=value))
    return concat(found)[[*KEY, *SCORES]].sort_values(KEY, kind="stable", ignore_index=True)


def latency_job(store: Store, task: Task, trained: Trained, tables: CellTables) -> Job:
    """Time from an observation to the driver of the next step, for every method, with one learner."""
    ids = methods_in(task, task.paper_cell)
    key = store.key("latency", {"methods": list(ids)}, [*trained.keys, *tables.keys], ["safeswitch.sensitivity"])
    return Job("latency", task.name, key, _time, (str(store.root), task, trained, tables, ids))


def _time(folder: Path, root: str, task: Task, trained: Trained, tables: CellTables, ids: tuple[str, ...]) -> None:
    cell, rows = task.paper_cell, []
    loaded = tables.load(Store(Path(root)), task, cell)
    calibration = calibration_of(loaded, task, cell, "start", trained.seed)
    env = make_env(task, task.none_cell)
    frames = [_frames(env, int(seed)) for seed in loaded["test_nominal"].seeds[:TIMED]]
    for name in ids:
        method = registry.make_method(name)
        rule = method.calibrate(calibration).rule
        if rule is None or "expert-queries" in method.needs or not hasattr(rule, "update"):
            continue
        read = getattr(rule, "reads", (signal_of(name),))
        seconds = np.concatenate([_decide(task, trained, rule, read, each) for each in frames])
        p50, p95 = 1e3 * np.quantile(seconds, [0.5, 0.95])
        rows.append({"task": task.name, "method": name, "decisions": len(seconds), "p50_ms": p50, "p95_ms": p95})
    env.close()
    save_frame(folder / "latency.npz", pd.DataFrame(rows))


def _frames(env: Any, seed: int) -> list[tuple[Any, np.ndarray]]:
    """Observations of an episode that the expert drives, and its actions."""
    expert = env.make_expert()
    env.reset(seed=seed)
    expert.reset()
    found = []
    while not env.done:
        observation, action = env.observe(), expert.action(env.state, env.parameters)
        env.advance(action)
        found.append((observation, action))
    return found


def _decide(task: Task, trained: Trained, rule: Any, read: Any, frames: list[tuple[Any, np.ndarray]]) -> np.ndarray:
    """Seconds of each decision: the learner's prediction, the signals that are read, the rule."""
    learner, signals = trained.learner(task), trained.signals(task, set(read))
    learner.reset(0)
    rule.reset(0)
    rule.arm(0)
    for signal in signals:
        signal.reset()
    seconds, previous = [], None
    for step, (observation, action) in enumerate(frames):
        started = time.perf_counter()
        prediction = learner.predict(observation, step)
        values = {signal.id: signal.update(observation, prediction, previous) for signal in signals}
        rule.update(step, values | {DEVIATION: 0.0})
        seconds.append(time.perf_counter() - started)
        previous = action
    return np.array(seconds)
