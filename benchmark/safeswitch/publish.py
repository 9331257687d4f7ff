"""Writes what a run found: leaderboard, signals, comparisons, CEM's spread, manifest, figures and a short video.

Tables of several tasks share one folder: running one task replaces that task's rows only.
"""

from __future__ import annotations

import hashlib
import platform
import shutil
import subprocess
import time
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
from rich.markup import escape

from safeswitch import pictures, registry
from safeswitch.console import log
from safeswitch.files import load_frame, load_json, save_frame, save_json
from safeswitch.handover.published import file_name, write_table
from safeswitch.handover.table import HandoverTable
from safeswitch.report.views import tables_in
from safeswitch.scoring.comparisons import paired_comparisons
from safeswitch.scoring.failures import failure_table
from safeswitch.scoring.leaderboard import leaderboard, merge_task_rows, read_csv, write_csv
from safeswitch.scoring.left_out import left_out_lines, left_out_table
from safeswitch.scoring.markdown import write_markdown
from safeswitch.scoring.metrics import TaskInfo
from safeswitch.scoring.sightings import sighting_table
from safeswitch.scoring.signal_quality import signal_table
from safeswitch.scoring.thresholds import FILE as THRESHOLDS
from safeswitch.scoring.thresholds import plain_thresholds, write_thresholds
from safeswitch.scoring_stages import calibration_of, protocols_of
from safeswitch.sensitivity import sensitivity_table
from safeswitch.stages import Job, complete_job, load_rows, source_of
from safeswitch.store import Store
from safeswitch.suite import SPLIT_SIZE, SPLITS, TASKS, Cell, Split, Task, methods, without_extra

if TYPE_CHECKING:
    from safeswitch.pipeline import Run
    from safeswitch.stages import CellTables
    from safeswitch.trained import Trained

DRAWING = ["safeswitch.pictures", "safeswitch.scoring"]
"""Code that figures and films depend on."""
TABLES = ("leaderboard", "left_out", "signals", "comparisons", "failures")
LETTERS = {"failures": "F", "rollouts": "R", "expert-queries": "Q", "privileged": "P"}
"""What a method needs, as it stands in leaderboard.md."""
LIBRARIES = ("casadi", "dm-control", "gymnasium", "minari", "mujoco", "numpy", "pandas", "scipy", "torch")
CEM_SEEDS = 10
"""Seeds with which CEM is repeated to show the spread of mu*."""
CEM_STARTS = ("cem", "cem-high", "cem-low")
"""CEM from its own initial median, from ten times that and from a tenth."""


def publish(run: Run, folder: Path | None = None) -> Path:
    """Run every stage of a task and write its results; returns the folder."""
    folder = (folder or default_folder(run.profile.name)).absolute()
    started = time.time()
    commit = git_commit()  # before anything is written into the checkout
    run.plan_for(folder)
    for reason in without_extra().values():
        log.print(f"[yellow]{escape(reason)}[/]")
    scores, spread, varied, figures = run.scores, run.spread, run.varied, run.figures
    folder.mkdir(parents=True, exist_ok=True)
    for name in TABLES:
        _merge(folder / f"{name}.csv", read_csv(run.store.folder(scores.key) / f"{name}.csv"))
    sightings = run.store.folder(scores.key) / "sightings.csv"
    if sightings.exists():
        _merge(folder / "sightings.csv", read_csv(sightings))
    _merge(folder / "cem_seeds.csv", load_rows(run.store, spread, "cem_seeds.npz"))
    if varied:
        *changed, timed = varied
        _merge(folder / "sensitivity.csv", sensitivity_table(run.store, run.task, run.task_info, changed))
        _merge(folder / "latency.csv", load_rows(run.store, [timed], "latency.npz"))
    if run.literal is not None:
        for name in ("leaderboard", "signals"):
            table = read_csv(run.store.folder(run.literal.scores.key) / f"{name}.csv")
            _merge(folder / f"paper_literal_{name}.csv", table)
    _replace([run.store.folder(job.key) / pictures.PART for job in figures], folder / "figures" / run.task.name)
    _write_tables(run, folder / "tables" / run.task.name)
    manifest = _manifest(run, folder, commit, time.time() - started)
    save_json(folder / "manifest.json", manifest)
    names = dict.fromkeys(name for task in (run.task, *TASKS.values()) for name in methods(task.signals))
    needs = {name: _letters(registry.make_method(name).needs) for name in names}
    left_out = read_csv(folder / "left_out.csv")
    write_markdown(
        read_csv(folder / "leaderboard.csv"),
        folder / "leaderboard.md",
        {name: (task.paper_cell.disturbance, task.paper_cell.severity) for name, task in TASKS.items()},
        privileged=[name for name in names if "privileged" in registry.make_method(name).needs],
        give_back=[name for name in names if not registry.make_method(name).latched],
        notes=[f"{name}: profile {entry['profile']}, commit {entry['commit']}" for name, entry in manifest.items()],
        needs=needs,
        first={str(task): left_out_lines(rows, needs) for task, rows in left_out.groupby("task")},
    )
    return folder


def _letters(needs: frozenset[str]) -> str:
    """What a method needs in letters, in the order of `LETTERS`; a dash for nothing."""
    return " ".join(letter for name, letter in LETTERS.items() if name in needs) or "–"


def default_folder(profile: str) -> Path:
    """`results/` for the full profile, `results/local/<profile>/` otherwise; in the checkout, else in this folder."""
    checkout = Path(__file__).resolve().parents[2]
    base = (checkout if (checkout / "pyproject.toml").is_file() else Path.cwd()) / "results"
    return base if profile == "full" else base / "local" / profile


def scores_job(store: Store, task: Task, info: TaskInfo, episodes: list[Job], signals: list[Job]) -> Job:
    """Leaderboard, signal quality and paired comparisons of one task."""
    keys = [job.key for job in [*episodes, *signals]]
    code = ["safeswitch.scoring"]
    key = store.key("scores", {"task": task.name}, keys, code)
    return Job("scores", task.name, key, _score, (str(store.root), task, info, episodes, signals))


def _score(folder: Path, root: str, task: Task, info: TaskInfo, episodes: list[Job], signals: list[Job]) -> None:
    store, infos = Store(Path(root)), {task.name: info}
    rows = load_rows(store, episodes, "episodes.npz")
    write_csv(leaderboard(rows, infos), folder / "leaderboard.csv")
    write_csv(left_out_table(rows, infos), folder / "left_out.csv")
    write_csv(paired_comparisons(rows, infos), folder / "comparisons.csv")
    write_csv(signal_table(load_rows(store, signals, "signals.npz")), folder / "signals.csv")
    write_csv(failure_table(map(partial(_tested, store), episodes)), folder / "failures.csv")
    seen = load_rows(store, signals, "sightings.npz")
    if len(seen):
        write_csv(sighting_table(seen), folder / "sightings.csv")


def _tested(store: Store, job: Job) -> tuple[Cell, int, HandoverTable]:
    """Cell, learner seed and test episodes of an `episodes_job`."""
    return job.arguments[2], job.arguments[3].seed, HandoverTable.load(store.folder(job.key) / "test.npz")


def spread_job(store: Store, task: Task, learner: int, tables: CellTables) -> Job:
    """mu* of CEM over its seeds, and from initial values ten times off, for one learner in the paper's cell."""
    keys = [*tables.calibrate, *tables.calibrate_nominal]
    settings = {"task": task.name, "learner": learner, "seeds": CEM_SEEDS, "signals": list(task.signals)}
    key = store.key("spread", settings, keys, ["safeswitch.handover.panel", source_of("method", "cem")])
    return Job("spread", f"{task.name} learner {learner}", key, _spread, (str(store.root), task, learner, tables))


def _spread(folder: Path, root: str, task: Task, learner: int, tables: CellTables) -> None:
    cell, rows = task.paper_cell, []
    loaded = tables.load(Store(Path(root)), task, cell)
    for protocol in protocols_of(cell):
        for seed in range(CEM_SEEDS):
            calibration = calibration_of(loaded, task, cell, protocol, seed)
            for method in (f"{family}@{signal}" for family in CEM_STARTS for signal in task.signals):
                learned = registry.make_method(method).calibrate(calibration)
                rows.append(_spread_row(cell, protocol, method, learner, seed, learned.threshold))
    save_frame(folder / "cem_seeds.npz", pd.DataFrame(rows))


def _spread_row(cell: Cell, protocol: str, method: str, learner: int, seed: int, threshold: float) -> dict[str, Any]:
    return {
        "task": cell.task,
        "disturbance": cell.disturbance,
        "severity": cell.severity,
        "protocol": protocol,
        "method": method,
        "learner": learner,
        "cem_seed": seed,
        "threshold": threshold,
    }


def figures_job(store: Store, task: Task, episodes: Job, tables: CellTables, scores: Job) -> Job:
    """Figures of the first learner in the paper's cell."""
    key = store.key("figures", {"task": task.name}, [episodes.key, scores.key], DRAWING)
    return Job(
        "figures", f"{task.name} figures", key, pictures.draw, (str(store.root), task, episodes.key, tables, scores.key)
    )


def film_job(store: Store, task: Task, trained: Trained, episodes: Job, tables: CellTables) -> Job:
    """Film of one of its episodes there, under several drivers."""
    key = store.key("film", {"task": task.name}, [*trained.keys, episodes.key], DRAWING)
    return Job("film", f"{task.name} film", key, pictures.film, (str(store.root), task, trained, episodes.key, tables))


def _write_tables(run: Run, folder: Path) -> None:
    """Tables of the first three cells, to score latched rules without MuJoCo.

    In the full profile both splits, apart and with every outcome computed; otherwise the test episodes with the
    outcomes that are known. Beside them, to the last bit, the thresholds of those methods that are a constant one.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    rows = {}
    for job in run.episodes:
        cell, trained = job.arguments[2], job.arguments[3]
        if cell in run.task.cells[:3]:
            source = run.store.folder(job.key)
            rows[cell, trained.seed] = load_frame(source / "episodes.npz")
            if not run.profile.tables:
                name = file_name(cell.label, cell.severity, "test", trained.seed)
                shutil.copyfile(source / "test.npz", folder / name)
    if run.profile.tables:
        _write_complete_tables(run, folder)
    plain = []
    for view in tables_in(folder, run.task).views():
        for learner, panel in view.panels.items():
            frame = rows[view.cell, learner]
            plain.append(plain_thresholds(panel, frame[frame["protocol"] == view.protocol]))
    write_thresholds(pd.concat(plain, ignore_index=True), folder / THRESHOLDS)


def _write_complete_tables(run: Run, folder: Path) -> None:
    """Both splits of the first three cells; the calibrate episodes that thresholds come from."""
    jobs: dict[tuple[Cell, Split, int], Job] = {}
    for seed, cell in product(range(run.profile.learners), run.task.cells[:3]):
        tables = run.tables[seed, str(cell)]
        keys: dict[Split, tuple[str, ...]] = {"test": tables.test}
        if cell in (run.task.paper_cell, run.task.none_cell):  # thresholds of the others come from these
            keys["calibrate"] = tables.calibrate_nominal if cell == run.task.none_cell else tables.calibrate
        for split, recorded in keys.items():
            jobs[cell, split, seed] = complete_job(run.store, run.task, cell, recorded)
    run.finish("published tables", jobs.values())
    for (cell, split, seed), job in jobs.items():
        write_table(HandoverTable.load(run.store.folder(job.key) / "table.npz"), folder, cell, split, seed)


def _merge(target: Path, rows: pd.DataFrame) -> None:
    """Replace the rows of this task in a table of all tasks."""
    write_csv(merge_task_rows(target if target.exists() else None, rows), target)


def _replace(sources: list[Path], target: Path) -> None:
    """Make `target` hold the files of `sources`, and nothing else."""
    shutil.rmtree(target, ignore_errors=True)
    for source in sources:
        shutil.copytree(source, target, dirs_exist_ok=True)


def _manifest(run: Run, folder: Path, commit: str, seconds: float) -> dict[str, Any]:
    """The folder's manifest with this task's entry replaced."""
    path = folder / "manifest.json"
    manifest = load_json(path) if path.exists() else {}
    manifest[run.task.name] = {
        "commit": commit,
        "profile": run.profile.name,
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "versions": {"python": platform.python_version(), **{name: installed(name) for name in LIBRARIES}},
        "hardware": {"machine": platform.machine(), "processor": _processor(), "workers": run.workers},
        "learner_seeds": list(range(run.profile.learners)),
        "episodes": {"calibrate": run.profile.calibrate, "test": run.profile.test},
        "episode_seeds": {split: index * SPLIT_SIZE for index, split in enumerate(SPLITS)},
        "stage_seconds": {
            name: {
                "wall, this run": round(wall, 1),
                "work, when computed": round(run.work[name], 1),
                "jobs": run.jobs[name],
            }
            for name, wall in run.seconds.items()
        },
        "wall_seconds": round(seconds, 1),
        "store_keys": {"demonstrations": run.demonstrations.key, "scores": run.scores.key},
        "sha256": {f"{name}.csv": _sha(run.store.folder(run.scores.key) / f"{name}.csv") for name in TABLES},
    }
    return dict(sorted(manifest.items()))


def git_commit() -> str:
    """Hash of the checkout's commit, with "-dirty" if tracked files were changed; "unknown" outside a checkout."""
    root = Path(__file__).resolve().parents[2]

    def git(*arguments: str) -> str:
        return subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True).stdout

    try:
        changed = [line for line in git("status", "--porcelain", "-uno").splitlines() if "results/" not in line]
        return git("rev-parse", "HEAD").strip() + ("-dirty" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _processor() -> str:
    """Name of the processor, as far as the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


def installed(distribution: str) -> str:
    """Version of an installed distribution."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"


def _sha(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
