"""The stages of a run as jobs: what each computes, what it depends on, and where the store keeps it.

A job's key hashes its settings, the keys of its inputs, the source of the modules that it runs and the versions of
the libraries beneath. A finished job is never run again; a change runs again only what depends on it. Every job is a
pure function of its arguments, so the bits do not depend on the number of workers or on interruptions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import pandas as pd

from safeswitch import demos, registry
from safeswitch.files import load_frame, save_arrays, save_frame
from safeswitch.handover.episode import run_episode
from safeswitch.handover.panel import Calibration, Panel
from safeswitch.handover.shown import shown_traces
from safeswitch.handover.table import HandoverTable, concatenate, join_chunks, record_table
from safeswitch.protocols import ARMINGS, Arming, TrainingFeatures
from safeswitch.scoring.rows import episode_rows, latched_rows
from safeswitch.scoring.signal_quality import SignalQuality, frame_quality, signal_quality
from safeswitch.store import Key, Store
from safeswitch.suite import Cell, Profile, Split, Task, episode_seeds, methods
from safeswitch.trained import Trained, base_signals, fitted_signals, load_learner

if TYPE_CHECKING:
    from safeswitch.protocols import Method
    from safeswitch.tasks.base import TaskEnv

FIT_EPISODES = 250
"""Demonstrations to whose features signals are fitted: 20,000 steps, many times the number of features."""

CHUNK = 20
"""Episodes per table job: small enough to resume from and to spread over workers."""

SHOWN_CHUNKS = 1
"""Chunks of undisturbed episodes (1,600 states a learner) on which a disturbance that is only seen is shown to the signals."""

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
    """Package (or module) whose source a registered learner, signal or method depends on."""
    module = registry.find(kind, name).__module__
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


def learner_job(store: Store, task: Task, profile: Profile, seed: int, demonstrations: Job) -> Job:
    """A learner trained on the demonstrations; `seed` draws its initial weights, batches and dropout."""
    options = {**task.learner_options, **profile.learner_options}
    settings = {"learner": task.learner, "seed": seed, **options}
    key = store.key("learner", settings, [demonstrations.key], [source_of("learner", task.learner)])
    arguments = (task, options, seed, str(store.folder(demonstrations.key)))
    return Job("learner", f"{task.name} learner {seed}", key, _train, arguments)


def _train(folder: Path, task: Task, options: dict[str, Any], seed: int, dataset_root: str) -> None:
    factory = registry.find("learner", task.learner)
    learner = factory.train(demos.load(task.dataset, Path(dataset_root)), seed, options)
    learner.save(folder / "learner")


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
    count: int,
    trained: Trained,
    twins: Sequence[Job] = (),
) -> list[Job]:
    """The handover table of one (cell, learner) on the first `count` seeds of a split, in chunks of episodes.

    Outcomes are computed here for the cells whose tables are used again and again (`Cell.complete`); elsewhere they
    are computed when a rule first asks for them. Where the disturbance is only seen, those up to the onset are taken
    from `twins`, finished jobs of the undisturbed cell.
    """
    twins = twins if only_seen(cell) else ()
    code = [*PHYSICS, *task.code(), *HANDOVER, source_of("learner", task.learner), *signal_code(task)]
    jobs = []
    for index, first in enumerate(range(0, count, CHUNK)):
        size = min(CHUNK, count - first)
        twin = [twins[index].key] if twins else []
        settings = {
            "env": task.env_id,
            "cell": cell.env_kwargs,
            "split": split,
            "seeds": episode_seeds(split, size, first),
            "signals": list(task.signals),
            "complete": cell.complete,
        }
        key = store.key("table", settings, [*trained.keys, *twin], code)
        label = f"{cell} {split} {first}-{first + size - 1} (learner {trained.seed})"
        arguments = (task, cell, split, first, size, trained, [str(store.folder(key)) for key in twin])
        jobs.append(Job("table", label, key, _tabulate, arguments))
    return jobs


def _tabulate(
    folder: Path,
    task: Task,
    cell: Cell,
    split: Split,
    first: int,
    count: int,
    trained: Trained,
    twins: Sequence[str],
) -> None:
    env = make_env(task, cell)
    seeds = episode_seeds(split, count, first)
    table = record_table(env, trained.learner(task), trained.signals(task), env.make_expert(), seeds)
    for twin in twins:
        table.share(HandoverTable.load(Path(twin) / "table.npz"))
    if cell.complete:
        table.complete()
    table.save(folder / "table.npz")
    env.close()


def load_table(store: Store, task: Task, cell: Cell, keys: tuple[str, ...]) -> HandoverTable:
    """The chunks of a table put together, with a simulator that resolves the outcomes still unknown."""
    table = join_chunks([HandoverTable.load(store.folder(key) / "table.npz") for key in keys])
    env = make_env(task, cell)
    return table.attach(env, env.make_expert())


@dataclass(frozen=True)
class CellTables:
    """Keys of the table chunks that one (learner, cell) is calibrated and tested on."""

    calibrate: tuple[str, ...]
    calibrate_nominal: tuple[str, ...]
    test: tuple[str, ...]
    test_nominal: tuple[str, ...]

    def load(self, store: Store, task: Task, cell: Cell) -> dict[str, HandoverTable]:
        """Each table by the name of its attribute; tables of the same episodes are one object."""
        on = task.calibrated_on(cell)
        cells = {"calibrate": on, "calibrate_nominal": task.none_cell, "test": cell, "test_nominal": task.none_cell}
        by_keys: dict[tuple[str, ...], HandoverTable] = {}
        for name, its_cell in cells.items():
            keys = getattr(self, name)
            if keys not in by_keys:
                by_keys[keys] = load_table(store, task, its_cell, keys)
        return {name: by_keys[getattr(self, name)] for name in cells}


def episodes_job(store: Store, task: Task, cell: Cell, trained: Trained, tables: CellTables, give_back: bool) -> Job:
    """Calibrate every method and score it on the test episodes of one (learner, cell), under both armings."""
    ids = methods(task.signals)
    settings = {"cell": str(cell), "learner_seed": trained.seed, "methods": list(ids), "give_back": give_back}
    keys = [*tables.calibrate, *tables.calibrate_nominal, *tables.test, *tables.test_nominal]
    rules = {source_of("method", name.partition("@")[0]) for name in ids}
    code = ["safeswitch.handover.panel", "safeswitch.scoring.rows", *sorted(rules)]
    key = store.key("episodes", settings, [*trained.keys, *keys], code)
    arguments = (str(store.root), task, cell, trained, tables, give_back)
    return Job("episodes", f"{cell} learner {trained.seed}", key, _score_episodes, arguments)


def _score_episodes(
    folder: Path,
    root: str,
    task: Task,
    cell: Cell,
    trained: Trained,
    tables: CellTables,
    give_back: bool,
) -> None:
    loaded = tables.load(Store(Path(root)), task, cell)
    frames, logs = [], {}
    for protocol in protocols_of(cell):
        test = test_panel(loaded, cell, protocol)
        calibration = calibration_of(loaded, task, cell, protocol, trained.seed)
        for method_id in methods(task.signals):
            method: Method = registry.make_method(method_id)
            if not method.latched and not give_back:
                continue
            calibrated = method.calibrate(calibration)
            if method.latched:
                rows = latched_rows(test, calibrated)
            else:
                rows = _plain_rows(task, cell, trained, test, calibrated.rule)
            on = "" if task.calibrated_on(cell) == cell else str(task.calibrated_on(cell))
            frames.append(labelled(rows, cell, protocol, method_id, trained.seed, calibrated, on))
            logs.update({f"{protocol}|{method_id}|{name}": value for name, value in calibrated.log.items()})
    save_frame(folder / "episodes.npz", concat(frames))
    save_arrays(folder / "logs.npz", **logs)
    loaded["test"].save(folder / "test.npz", snapshots=False)


def protocols_of(cell: Cell) -> tuple[Arming, ...]:
    """Armings under which a cell is scored: without a disturbance there is no onset."""
    return ("start",) if cell.tag == "none" else ARMINGS


def test_panel(loaded: dict[str, HandoverTable], cell: Cell, protocol: Arming) -> Panel:
    """Test episodes of a cell under an arming."""
    return _panel(loaded["test"], loaded["test_nominal"], cell, protocol)


def calibration_of(
    loaded: dict[str, HandoverTable], task: Task, cell: Cell, protocol: Arming, seed: int
) -> Calibration:
    """Calibrate episodes of a cell under an arming."""
    panel = _panel(loaded["calibrate"], loaded["calibrate_nominal"], task.calibrated_on(cell), protocol)
    return Calibration(panel, loaded["calibrate_nominal"], seed=seed)


def _panel(table: HandoverTable, nominal: HandoverTable, cell: Cell, protocol: Arming) -> Panel:
    """Disturbed episodes, and under `start` their undisturbed twins beside them."""
    if cell.tag == "none":
        return Panel(nominal, protocol)
    return Panel(concatenate([table, nominal]) if protocol == "start" else table, protocol)


def _plain_rows(task: Task, cell: Cell, trained: Trained, test: Panel, rule: Any) -> pd.DataFrame:
    """Rules that give control back have no table: drive the same episodes."""
    driver, signals = trained.learner(task), trained.signals(task)
    envs = {True: make_env(task, cell), False: make_env(task, task.none_cell)}
    experts = {kind: env.make_expert() for kind, env in envs.items()}
    episodes = [
        run_episode(envs[bool(kind)], driver, signals, rule, experts[bool(kind)], int(seed), test.arming)
        for seed, kind in zip(test.table.seeds, test.table.disturbed, strict=True)
    ]
    for env in envs.values():
        env.close()
    return episode_rows(test, episodes)


def concat(frames: list[pd.DataFrame]) -> pd.DataFrame:
    """Frames below one another."""
    return pd.concat(frames, ignore_index=True)


def labelled(
    rows: pd.DataFrame, cell: Cell, protocol: str, method_id: str, learner_seed: int, calibrated: Any, on: str
) -> pd.DataFrame:
    """Rows of `scoring.rows` with the columns that say what they are rows of."""
    return rows.assign(
        task=cell.task,
        disturbance=cell.disturbance,
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

    A disturbance that is only seen is judged on the twins' states, with and without it in view; then no disturbed
    episode is needed for the frames.
    """
    settings = {"cell": str(cell), "learner_seed": trained.seed, "signals": list(task.signals)}
    code = ["safeswitch.scoring.signal_quality", "safeswitch.handover.table", "safeswitch.handover.shown"]
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
    twins = load_table(store, task, task.none_cell, twin_keys)
    by_signal: dict[str, SignalQuality] = {}
    if disturbed_keys:
        disturbed = load_table(store, task, cell, disturbed_keys)
        about = (disturbed.onset, disturbed.t_first, disturbed.learner_success)
        for signal in task.signals:
            by_signal[signal] = signal_quality(disturbed.signals[signal], twins.signals[signal], *about)
    if only_seen(cell):
        env = make_env(task, cell)
        states = load_table(store, task, task.none_cell, twin_keys[:SHOWN_CHUNKS])
        shown, visible = shown_traces(env, trained.learner(task), trained.signals(task), states)
        env.close()
        for signal in task.signals:
            frames = frame_quality(shown[signal], states.signals[signal], visible)
            before = by_signal.get(signal, frames)
            by_signal[signal] = replace(frames, episode_auroc=before.episode_auroc)
    rows = [{"signal": signal, **asdict(quality)} for signal, quality in by_signal.items()]
    frame = pd.DataFrame(rows).assign(
        task=cell.task, disturbance=cell.disturbance, severity=cell.severity, learner=trained.seed
    )
    save_frame(folder / "signals.npz", frame)


def only_seen(cell: Cell) -> bool:
    """Whether the disturbance changes nothing but the picture: the same state can then be seen without it."""
    from safeswitch.tasks import visual  # noqa: F401  (registers the disturbances of images)
    from safeswitch.tasks.disturbances import DISTURBANCES  # imports mujoco

    return cell.tag != "none" and DISTURBANCES[cell.disturbance].only_seen


def load_rows(store: Store, jobs: list[Job], name: str) -> pd.DataFrame:
    """The data frames that jobs wrote as `name`, put together."""
    return concat([load_frame(store.folder(job.key) / name) for job in jobs])
