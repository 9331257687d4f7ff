"""Reference learners: one trained learner a task, shipped with the package that the learner comes from.

`safeswitch reference --task cart-pole` makes it from the suite's own run (demonstrations and training of a profile,
learner seed 0): its weights, its handover tables in the paper's cell and undisturbed on the calibrate and the test
split, and a manifest. Tables of other cells are recorded from the weights when they are first needed, and kept in the
cache folder, `$SAFESWITCH_CACHE` or `~/.cache/safeswitch`, under a hash of the weights, the code and the libraries.
"""

from __future__ import annotations

import hashlib
import shutil
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from joblib import Parallel, cpu_count, delayed

from safeswitch import registry
from safeswitch.console import Progress
from safeswitch.execution import processes
from safeswitch.files import load_json, save_json
from safeswitch.handover.published import PublishedTables, file_name, write_table
from safeswitch.handover.served import SPLITS
from safeswitch.handover.table import HandoverTable, concatenate
from safeswitch.protocols import Array
from safeswitch.stages import Job, complete_job, table_jobs
from safeswitch.store import Key, Store
from safeswitch.suite import Cell, Split, Task
from safeswitch.trained import Trained, fitted_signals, needs_members

if TYPE_CHECKING:
    from safeswitch.pipeline import Run

SEED = 0
"""Learner seed of the reference weights."""
EPISODES = 100
"""Episodes of each shipped table: as many as the standard profile has."""
MANIFEST, LEARNER = "manifest.json", "learner"


@dataclass(frozen=True)
class Reference(Trained):
    """The reference learner of a task; it stands in the place of a learner of a run.

    Attributes:
        weights: SHA-256 of its weights, on which everything depends that is recorded with it.
    """

    weights: str = ""

    @property
    def keys(self) -> list[str]:
        """What an episode with this learner depends on."""
        return [self.weights]


def reference_folder(task: Task) -> Path:
    """Folder of a task's reference weights, in the package that registers its learner; it need not exist."""
    return registry.package_folder("learner", task.learner) / "reference" / task.name


def reference_signals(task: Task) -> tuple[str, ...]:
    """The task's signals that need the learner alone: neither fits to its training steps nor other learners."""
    fitted = fitted_signals(task)
    return tuple(name for name in task.signals if registry.base_signal(name) not in fitted and not needs_members(name))


def reference(task: Task) -> Reference:
    """The reference learner of a task.

    Raises:
        FileNotFoundError: it has none yet; the message says how to make it.
    """
    folder = reference_folder(task)
    if not (folder / MANIFEST).is_file():
        raise FileNotFoundError(
            f"task {task.name!r} has no reference weights in {folder}: make them with "
            f"`safeswitch reference --task {task.name}`, or name a folder of handover tables with tables=..."
        )
    weights = load_json(folder / LEARNER / "config.json")["weights_sha256"]
    if weights != load_json(folder / MANIFEST)["weights_sha256"]:
        raise ValueError(f"{folder}: the weights are not those of {MANIFEST}; make them again")
    return Reference(str(folder.parent), SEED, Key(task.name, {}), weights=weights)


def reference_table(task: Task, cell: Cell, split: Split, episodes: int = EPISODES) -> HandoverTable:
    """The complete handover table of the reference learner: the shipped one, or recorded where it does not suffice."""
    learner = reference(task)
    path = reference_folder(task) / file_name(cell.label, cell.severity, split, SEED)
    if path.is_file():
        shipped = PublishedTables.find(path.parent).load(cell.label, cell.severity, split, SEED)
        if len(shipped) >= episodes:
            return smoothed(shipped.take(np.arange(episodes)), task)
    return record(learner, task, cell, split, episodes)


class _Recorded:
    """A signal whose values over one episode are known: stands in for it where it is smoothed afterwards."""

    def __init__(self, name: str, values: Array) -> None:
        self.id = name
        self._values = values

    def reset(self) -> None:
        """Start at the episode's first step."""
        self._step = 0

    def update(self, observation: Any, prediction: Any, previous_action: Any) -> float:
        """The recorded value of the next step."""
        self._step += 1
        return float(self._values[self._step - 1])


def smoothed(table: HandoverTable, task: Task) -> HandoverTable:
    """The table with those smoothed signals of `reference_signals` that it lacks, the same bits as when recorded."""
    unseen: Any = None  # a recorded signal looks at nothing
    for name in reference_signals(task):
        base = registry.base_signal(name)
        if name not in table.signals:
            trace = np.full((len(table), table.horizon), np.nan)
            for row, (values, length) in enumerate(zip(table.signals[base], table.length, strict=True)):
                signal = registry.make_signal(name, factories={base: partial(_Recorded, base, values)})
                signal.reset()
                trace[row, :length] = [signal.update(unseen, unseen, None) for _ in range(length)]
            table = table.with_signal(name, trace)
    return table


def unsmoothed(table: HandoverTable) -> HandoverTable:
    """The table without its smoothed signals, which `smoothed` makes again: less to ship."""
    kept = {name: trace for name, trace in table.signals.items() if name == registry.base_signal(name)}
    return replace(table, signals=kept)


def record(
    learner: Reference, task: Task, cell: Cell, split: Split, episodes: int, store: Store | None = None
) -> HandoverTable:
    """The same, recorded with a progress bar where the cache lacks it.

    Args:
        learner: the reference learner.
        task: the task; signals that the reference learner cannot give are left out.
        cell: any of its cells.
        split: of the episode seeds.
        episodes: the first so many of them.
        store: cache of tables; the default is in the cache folder.
    """
    from safeswitch.expert.codegen import cache_dir

    store = store or Store(cache_dir() / "reference")
    task = replace(task, signals=reference_signals(task))
    recorded = table_jobs(store, task, cell, split, episodes, learner)
    completed = [complete_job(store, task, cell, (job.key,)) for job in recorded]
    label = f"{cell}: recording {episodes} {split} episodes of the reference learner, once"
    pending = [pair for pair in zip(recorded, completed, strict=True) if not store.has(pair[1].key)]
    if pending:
        with (
            Progress(label, len(recorded), len(recorded) - len(pending)) as progress,
            processes(min(cpu_count(), len(pending))),
        ):
            run = Parallel(return_as="generator_unordered")(delayed(_run)(str(store.root), pair) for pair in pending)
            for name in run:
                progress.advance(name)
    return concatenate([HandoverTable.load(store.folder(job.key) / "table.npz") for job in completed])


def _run(root: str, jobs: tuple[Job, ...]) -> str:
    """Run jobs one after the other, those that the store lacks."""
    store = Store(Path(root))
    for job in jobs:
        if not store.has(job.key):
            with store.writing(job.key) as folder:
                job.run(folder, *job.arguments)
    return jobs[-1].label


def make_reference(run: Run, folder: Path | None = None) -> tuple[Path, dict[str, Any]]:
    """Write the reference learner of a run's task, its tables, and a manifest that says where they are from.

    Returns:
        The folder and the manifest.
    """
    from safeswitch.publish import LIBRARIES, git_commit, installed

    commit = git_commit()
    folder = folder or reference_folder(run.task)
    job = run.learners[SEED]
    target = folder / LEARNER
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(run.store.folder(job.key) / LEARNER, target)
    weights = load_json(target / "config.json")["weights_sha256"]
    learner = Reference(str(folder.parent), SEED, Key(folder.name, {}), weights=weights)
    tables = {}
    for cell in (run.task.none_cell, run.task.paper_cell):
        for split in SPLITS:
            table = unsmoothed(record(learner, run.task, cell, split, EPISODES, run.store))
            path = write_table(table, folder, cell, split, SEED)
            tables[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    manifest = {
        "task": run.task.name,
        "learner": run.task.learner,
        "learner_seed": SEED,
        "profile": run.profile.name,
        "commit": commit,
        "weights_sha256": weights,
        "tables_sha256": tables,
        "episodes": EPISODES,
        "store_keys": {"demonstrations": run.demonstrations.key, "learner": job.key},
        "versions": {name: installed(name) for name in LIBRARIES},
        "bytes": sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()),
    }
    save_json(folder / MANIFEST, manifest)
    return folder, manifest
