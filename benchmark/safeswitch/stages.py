"""The stages of a run as jobs: what each computes, what it depends on, and where the store keeps it.

A job's key hashes its settings, the keys of its inputs, the source of the modules that it runs and the versions of
the libraries beneath. A finished job is never run again; a change runs again only what depends on it. Every job is a
pure function of its arguments, so the bits do not depend on the number of workers or on interruptions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import pandas as pd

from safeswitch import demos, factories, registry
from safeswitch.files import load_frame, save_arrays
from safeswitch.handover.outcomes import UNKNOWN
from safeswitch.handover.table import HandoverTable, concatenate, join_chunks, record_table
from safeswitch.protocols import TrainingFeatures
from safeswitch.store import Key, Store
from safeswitch.suite import Cell, Profile, Split, Task, episode_seeds
from safeswitch.trained import Trained, base_signals, fitted_signals, load_learner

if TYPE_CHECKING:
    from safeswitch.tasks.base import TaskEnv

FIT_EPISODES = 250
"""Demonstrations to whose features signals are fitted: 20,000 steps, many times the number of features."""

CHUNK = 20
"""Episodes per table job: small enough to resume from and to spread over workers."""

PHYSICS = (
    "safeswitch.seeding",
    "safeswitch.tasks.base",
    "safeswitch.tasks.disturbances",
    "safeswitch.tasks.models",
    "safeswitch.tasks.simulator",
    "safeswitch.expert.box_qp",
    "safeswitch.expert.codegen",
    "safeswitch.expert.ddp",
    "safeswitch.expert.ddp_parts",
    "safeswitch.expert.graph",
    "safeswitch.expert.mpc",
)
HANDOVER = ("safeswitch.handover.episode", "safeswitch.handover.outcomes", "safeswitch.handover.table")


def source_of(kind: registry.Kind, name: str) -> str:
    """Package (or module) whose source a learner, signal or method depends on."""
    module = name.partition(":")[0] if ":" in name else registry.find(kind, name).__module__
    return module.rpartition(".")[0] or module


@dataclass(frozen=True)
class Job:
    """One unit of work: `run(folder, *arguments)` writes its results into `folder`, kept under `key`."""

    stage: str
    label: str
    key: Key
    run: Callable[..., None]
    arguments: tuple[Any, ...]


def make_env(task: Task, cell: Cell, **kwargs: Any) -> TaskEnv:
    """The task's environment in a cell, without Gymnasium's wrappers."""
    env: Any = gymnasium.make(task.env_id, **cell.env_kwargs, **kwargs).unwrapped
    return env


def demonstrations_job(store: Store, task: Task, profile: Profile, workers: int = 1) -> Job:
    """Demonstrations of the expert as a Minari dataset; one job, which spreads its episodes over workers itself."""
    settings = {**task.demonstrations, **profile.demonstrations}
    key = store.key(
        "demonstrations",
        {"env": task.env_id, "dataset": task.dataset, **settings},
        [],
        [*PHYSICS, *task.code(), "safeswitch.demos", "safeswitch.datasets"],
    )
    return Job("demonstrations", task.name, key, _demonstrate, (task, settings, workers))


def _demonstrate(folder: Path, task: Task, settings: dict[str, Any], workers: int) -> None:
    options = dict(settings)
    seeds = episode_seeds("train", options.pop("episodes"))
    demos.collect(task.env_id, task.dataset, folder, seeds, n_jobs=workers, **options)


def learner_job(store: Store, task: Task, profile: Profile, seed: int, demonstrations: Job | None) -> Job:
    """A learner trained on the demonstrations; `seed` draws its initial weights, batches and dropout.

    Without demonstrations it is a ready-made one, which is told apart by what it predicts.
    """
    options = {**task.learner_options, **profile.learner_options}
    settings = {"learner": task.learner, "seed": seed, **options}
    if demonstrations is None:
        env = make_env(task, task.none_cell)
        settings["predictions"] = factories.fingerprint(task.learner, seed, env)
        env.close()
    inputs = [] if demonstrations is None else [demonstrations.key]
    code = [source_of("learner", task.learner)]
    if not factories.is_kept(registry.find("learner", task.learner)):
        code.append("safeswitch.factories")  # which then decides what the result holds
    key = store.key("learner", settings, inputs, code)
    arguments = (task, options, seed, str(store.folder(demonstrations.key)) if demonstrations else "")
    return Job("learner", f"{task.name} learner {seed}", key, _train, arguments)


def _train(folder: Path, task: Task, options: dict[str, Any], seed: int, dataset_root: str) -> None:
    env = make_env(task, task.none_cell)
    factories.train(folder, task.learner, env, task.dataset, dataset_root, seed, options)
    env.close()


def fits_job(store: Store, task: Task, seed: int, learner: Job, demonstrations: Job) -> Job:
    """The task's fitted signals, fitted to the features that one learner has of its training steps."""
    names = fitted_signals(task)
    code = {source_of("learner", task.learner), *(source_of("signal", name) for name in names)}
    key = store.key(
        "signal-fits",
        {"signals": list(names), "seed": seed, "episodes": FIT_EPISODES},
        [learner.key, demonstrations.key],
        ["safeswitch.protocols", "safeswitch.seeding", *sorted(code)],
    )
    folders = (str(store.folder(learner.key)), str(store.folder(demonstrations.key)))
    return Job("signal-fits", learner.label, key, _fit_signals, (task, names, seed, *folders))


def _fit_signals(folder: Path, task: Task, names: tuple[str, ...], seed: int, learner: str, dataset_root: str) -> None:
    demonstrations = demos.load(task.dataset, Path(dataset_root)).first(FIT_EPISODES)
    training = TrainingFeatures(load_learner(task, learner), demonstrations)
    for name in names:
        save_arrays(folder / f"{name}.npz", **registry.find("signal", name).fit(training, seed))


def signal_code(task: Task) -> list[str]:
    """Packages whose source the task's signals depend on."""
    return sorted({source_of("signal", name) for name in ("smoothed", *base_signals(task.signals))})


def table_jobs(
    store: Store,
    task: Task,
    cell: Cell,
    split: Split,
    seeds: Sequence[int] | int,
    trained: Trained,
    twins: Sequence[Job] = (),
) -> list[Job]:
    """The handover table of one (cell, learner) on episode seeds of a split (or its first ones), in chunks of episodes.

    Outcomes are computed here for the tables that are used again and again (`Cell.complete`); elsewhere they are
    computed when a rule first asks for them, but for those that every score asks for. Where the disturbance is only
    seen, those up to the onset are taken from `twins`, finished jobs of the undisturbed cell.
    """
    twins = twins if only_seen(cell) else ()
    seeds = episode_seeds(split, seeds) if isinstance(seeds, int) else seeds
    code = [*PHYSICS, *task.code(), *HANDOVER, source_of("learner", task.learner), *signal_code(task)]
    complete, jobs = cell.complete(split), []
    for index, first in enumerate(range(0, len(seeds), CHUNK)):
        chunk = list(seeds[first : first + CHUNK])
        twin = [twins[index].key] if twins else []
        settings = {
            "env": task.env_id,
            "cell": cell.env_kwargs,
            "split": split,
            "seeds": chunk,
            "signals": list(task.signals),
            "complete": complete,
        }
        key = store.key("table", settings, [*trained.keys, *twin], code)
        label = f"{cell} {split} {first}-{first + len(chunk) - 1} (learner {trained.seed})"
        arguments = (task, cell, chunk, trained, [str(store.folder(key)) for key in twin], complete)
        jobs.append(Job("table", label, key, _tabulate, arguments))
    return jobs


def _tabulate(
    folder: Path,
    task: Task,
    cell: Cell,
    seeds: Sequence[int],
    trained: Trained,
    twins: Sequence[str],
    complete: bool,
) -> None:
    env = make_env(task, cell)
    table = record_table(env, trained.learner(task), trained.signals(task), env.make_expert(), seeds)
    for twin in twins:
        table.share(HandoverTable.load(Path(twin) / "table.npz"))
    if complete:
        table.complete()
    _ = table.t_first, table.t_last  # scores of rules and of signals need these outcomes, each in a job of its own
    table.save(folder / "table.npz")
    env.close()


def recorded_table(store: Store, keys: tuple[str, ...]) -> HandoverTable:
    """The chunks of a table put together, as they were recorded."""
    return join_chunks([HandoverTable.load(store.folder(key) / "table.npz") for key in keys])


def load_table(store: Store, task: Task, cell: Cell, keys: tuple[str, ...]) -> HandoverTable:
    """The same with a simulator that resolves the outcomes still unknown."""
    env = make_env(task, cell)
    return recorded_table(store, keys).attach(env, env.make_expert())


def complete_job(store: Store, task: Task, cell: Cell, recorded: tuple[str, ...]) -> Job:
    """Chunks of a recorded table as one, with every outcome computed and without snapshots."""
    code = [*PHYSICS, *task.code(), *HANDOVER]
    key = store.key("complete-table", {"env": task.env_id, "cell": cell.env_kwargs}, recorded, code)
    return Job("complete-table", str(cell), key, _complete, (str(store.root), task, cell, recorded))


def _complete(folder: Path, root: str, task: Task, cell: Cell, recorded: tuple[str, ...]) -> None:
    table = recorded_table(Store(Path(root)), recorded)
    if (table.known() == UNKNOWN).any():  # the simulator takes seconds to make
        env = make_env(task, cell)
        table.attach(env, env.make_expert())
    table.complete().save(folder / "table.npz", snapshots=False)


@dataclass(frozen=True)
class CellTables:
    """Keys of the table chunks that one (learner, cell) is calibrated and tested on.

    `others` has the calibrate chunks of the cells of every other disturbance, for the rows that leave this one out.
    """

    calibrate: tuple[str, ...]
    calibrate_nominal: tuple[str, ...]
    test: tuple[str, ...]
    test_nominal: tuple[str, ...]
    others: tuple[tuple[Cell, tuple[str, ...]], ...] = ()

    @property
    def keys(self) -> list[str]:
        """Keys of every chunk, in order."""
        others = [key for _, keys in self.others for key in keys]
        return [*self.calibrate, *self.calibrate_nominal, *self.test, *self.test_nominal, *others]

    def load_others(self, store: Store) -> HandoverTable | None:
        """The calibrate episodes of every other disturbance; None without."""
        tables = [recorded_table(store, keys) for _, keys in self.others]  # complete: they need no simulator
        return concatenate(tables) if tables else None

    def load(self, store: Store, task: Task, cell: Cell) -> dict[str, HandoverTable]:
        """Each table by the name of its attribute; tables of the same episodes are one object."""
        on = task.calibrated_on(cell)
        cells = {
            "calibrate": on,
            "calibrate_nominal": task.undisturbed(on),
            "test": cell,
            "test_nominal": task.undisturbed(cell),
        }
        by_keys: dict[tuple[str, ...], HandoverTable] = {}
        for name, its_cell in cells.items():
            keys = getattr(self, name)
            if keys not in by_keys:
                by_keys[keys] = load_table(store, task, its_cell, keys)
        return {name: by_keys[getattr(self, name)] for name in cells}


def only_seen(cell: Cell) -> bool:
    """Whether the disturbance changes nothing but the picture: the same state can then be seen without it."""
    from safeswitch.tasks import rally_disturbances, rally_visual, visual  # noqa: F401  (register disturbances)
    from safeswitch.tasks.disturbances import DISTURBANCES  # imports mujoco

    return cell.tag != "none" and DISTURBANCES[cell.disturbance].only_seen


def can_be_shown(cell: Cell) -> bool:
    """Whether undisturbed states can be seen with the disturbance: nothing else changes, or it stands ahead of them."""
    from safeswitch.tasks.disturbances import DISTURBANCES  # imports mujoco

    return cell.tag != "none" and (only_seen(cell) or DISTURBANCES[cell.disturbance].placed)


def concat(frames: list[pd.DataFrame]) -> pd.DataFrame:
    """Frames below one another."""
    return pd.concat(frames, ignore_index=True)


def load_rows(store: Store, jobs: list[Job], name: str) -> pd.DataFrame:
    """The data frames that jobs wrote as `name`, put together; an empty one if none of them did."""
    files = [path for job in jobs if (path := store.folder(job.key) / name).exists()]
    return concat([load_frame(path) for path in files]) if files else pd.DataFrame()
