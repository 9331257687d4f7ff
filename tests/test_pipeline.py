"""The pipeline: the same bytes whatever the workers and interruptions, and nothing computed twice."""

from __future__ import annotations

import ast
import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from joblib import Parallel, delayed
from joblib.externals.loky import get_reusable_executor

from micro import MICRO, TASK, leaderboard_bytes, micro_run
from safeswitch import execution, pipeline, scoring_stages, stages
from safeswitch.handover.episode import NeverSwitch, run_episode
from safeswitch.pipeline import Run
from safeswitch.stages import CellTables, Job
from safeswitch.store import Key, Store
from safeswitch.suite import Task
from safeswitch.trained import Trained, fitted_signals, signals_of

PASSIVE = {
    "safeswitch",  # registers the ids
    "safeswitch.files",
    "safeswitch.names",
    "safeswitch.protocols",
    "safeswitch.registry",
    "safeswitch.tasks",  # chooses the rendering backend
    "safeswitch.tasks.checks",  # errors alone
    "safeswitch.tasks.opengl",  # as rendering
    "safeswitch.tasks.rendering",  # pictures alone: an image task names it in its `modules`
    "safeswitch.tasks.rally_disturbances",  # of the rally car alone, which names them in its `modules`
    "safeswitch.tasks.rally_visual",  # as these
    "safeswitch.tasks.visual",  # as rendering: disturbances of what a camera sees
}
"""Modules that a stage may use without depending on their content: no number of a result comes from them."""


NOVEL = replace(TASK, signals=(*TASK.signals, "mahalanobis", "mahalanobis-mean3", "ensemble"))
"""The task with signals that are fitted, and that need the learners of other seeds."""


def jobs_of(store: Store, task: Task = TASK, members: tuple[Key, ...] = ()) -> dict[str, Job]:
    """One job of each stage, with its key; nothing is run."""
    cell = task.paper_cell
    demonstrations = stages.demonstrations_job(store, task, MICRO)
    learner = stages.learner_job(store, task, MICRO, 0, demonstrations)
    fits = stages.fits_job(store, task, 0, learner, demonstrations) if fitted_signals(task) else None
    trained = Trained(str(store.root), 0, learner.key, fits and fits.key, members)
    keys = {
        (each, split): tuple(job.key for job in stages.table_jobs(store, task, each, split, 2, trained))
        for each in (cell, task.none_cell)
        for split in ("calibrate", "test")
    }
    tables = CellTables(
        keys[cell, "calibrate"], keys[task.none_cell, "calibrate"], keys[cell, "test"], keys[task.none_cell, "test"]
    )
    table = stages.table_jobs(store, task, cell, "test", 2, trained)[0]
    episodes = scoring_stages.episodes_job(store, task, cell, trained, tables, ("cem@total",), give_back=False)
    signals = scoring_stages.signals_job(store, task, cell, trained, tables.test, tables.test_nominal)
    scores = pipeline.publish.scores_job(store, task, None, [episodes], [signals])  # type: ignore[arg-type]
    spread = pipeline.publish.spread_job(store, task, 0, tables)
    figures = pipeline.publish.figures_job(store, task, episodes, tables, scores)
    film = pipeline.publish.film_job(store, task, trained, episodes, tables)
    every = (demonstrations, learner, fits, table, episodes, signals, scores, spread, figures, film)
    return {job.stage: job for job in every if job is not None}


def edited(module: str) -> type[Store]:
    """A store that finds the source of `module` (or of a file of a package) changed."""

    class Edited(Store):
        def _hashes(self, code):
            return [(name, sha + "-edited" if name == module else sha) for name, sha in super()._hashes(code)]

    return Edited


@pytest.mark.parametrize(
    ("module", "run_again"),
    [
        ("safeswitch_baselines.rules/cem.py", {"episodes", "scores", "spread", "figures", "film"}),
        ("safeswitch_baselines.rules/thresholds.py", {"episodes", "scores", "spread", "figures", "film"}),
        ("safeswitch.handover.panel", {"episodes", "scores", "spread", "figures", "film"}),
        ("safeswitch.scoring/metrics.py", {"scores", "figures", "film"}),
        ("safeswitch.scoring/video.py", {"scores", "figures", "film"}),
        ("safeswitch.pictures", {"figures", "film"}),
        ("safeswitch.scoring.signal_quality", {"signals", "scores", "figures"}),
        ("safeswitch.handover.episode", {"table", "episodes", "signals", "scores", "spread", "figures", "film"}),
        (
            "safeswitch_baselines.signals/smoothing.py",
            {"table", "episodes", "signals", "scores", "spread", "figures", "film"},
        ),
        (
            "safeswitch_baselines.learners/networks.py",
            {"learner", "table", "episodes", "signals", "scores", "spread", "figures", "film"},
        ),
        ("safeswitch.demos", None),
        ("safeswitch.tasks.simulator", None),
        ("safeswitch.tasks.cart_pole", None),
        ("safeswitch.expert.box_qp", None),
        ("safeswitch.expert.cart_pole_model", None),
        ("cart_pole/cart_pole.xml", None),
    ],
)
def test_a_change_runs_again_what_depends_on_it_and_nothing_else(
    tmp_path: Path, module: str, run_again: set[str] | None
) -> None:
    before, after = jobs_of(Store(tmp_path)), jobs_of(edited(module)(tmp_path))
    changed = {stage for stage in before if before[stage].key != after[stage].key}
    assert changed == (set(before) if run_again is None else run_again)


def test_keys_depend_on_settings_and_not_on_the_folder(tmp_path: Path) -> None:
    one, other = jobs_of(Store(tmp_path / "a")), jobs_of(Store(tmp_path / "b"))
    assert {stage: job.key for stage, job in one.items()} == {stage: job.key for stage, job in other.items()}
    assert len({job.key for job in one.values()}) == len(one)
    store = Store(tmp_path)
    learners = {stages.learner_job(store, TASK, MICRO, seed, one["demonstrations"]).key for seed in range(3)}
    assert len(learners) == 3


def test_what_is_fitted_depends_on_learner_and_demonstrations_and_tables_depend_on_it(tmp_path: Path) -> None:
    assert "signal-fits" not in jobs_of(Store(tmp_path)), "nothing is fitted without such signals"
    jobs = jobs_of(Store(tmp_path), NOVEL)
    assert jobs["signal-fits"].key.recipe["inputs"] == [jobs["learner"].key, jobs["demonstrations"].key]
    assert jobs["signal-fits"].key.recipe["settings"]["signals"] == ["mahalanobis"], "once for its smoothed versions"
    assert jobs["table"].key.recipe["inputs"] == [jobs["learner"].key, jobs["signal-fits"].key]
    after = jobs_of(edited("safeswitch_baselines.signals/fitting.py")(tmp_path), NOVEL)
    assert {stage for stage in jobs if jobs[stage].key == after[stage].key} == {"demonstrations", "learner"}


def test_tables_of_an_ensemble_depend_on_every_learner(tmp_path: Path) -> None:
    store = Store(tmp_path)
    learners = [stages.learner_job(store, NOVEL, MICRO, seed, jobs_of(store)["demonstrations"]) for seed in range(3)]
    one = jobs_of(store, NOVEL, (learners[1].key,))["table"]
    both = jobs_of(store, NOVEL, (learners[1].key, learners[2].key))["table"]
    assert one.key != both.key and both.key.recipe["inputs"][2:] == [learners[1].key, learners[2].key]


def test_signals_that_need_other_learners_are_left_out_where_there_is_one(tmp_path: Path) -> None:
    assert signals_of(NOVEL, 2) == NOVEL.signals
    assert signals_of(NOVEL, 1) == (*TASK.signals, "mahalanobis", "mahalanobis-mean3")
    assert Run(NOVEL, MICRO, Store(tmp_path)).task.signals == signals_of(NOVEL, 1)
    assert Run(TASK, MICRO, Store(tmp_path)).task == TASK


def imports_of(module: str) -> Iterator[str]:
    """Modules of the suite that `module`, or any module of a package, imports, type checking aside."""
    spec = importlib.util.find_spec(module)
    assert spec is not None and spec.origin is not None
    origin = Path(spec.origin)
    for file in sorted(origin.parent.glob("*.py")) if origin.name == "__init__.py" else [origin]:
        yield from imports_in(file)


def imports_in(file: Path) -> Iterator[str]:
    """Modules of the suite that one source file imports."""
    tree = ast.parse(file.read_text())
    hidden = {
        each
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for each in ast.walk(node)
    }
    for node in ast.walk(tree):
        if node in hidden:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("safeswitch"))
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("safeswitch"):
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield name if is_module(name) else str(node.module)


def is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False


def test_the_key_of_a_table_covers_every_module_that_it_is_computed_with(tmp_path: Path) -> None:
    recipe = jobs_of(Store(tmp_path))["table"].key.recipe
    named = [name for name in recipe["code"] if not name.endswith((".xml", ".md"))]
    covered = {name.partition("/")[0] if "/" in name else name for name in named}
    for module in sorted(covered):
        for needed in imports_of(module):
            package = any(needed == each or needed.startswith(f"{each}.") for each in covered)
            # Demonstrations are an input, with a key of their own.
            assert package or needed in PASSIVE | {"safeswitch.demos"}, f"{module} imports {needed}"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bytes]:
    """A store in which the micro profile has run with one worker, and its leaderboard."""
    root = tmp_path_factory.mktemp("micro-one")
    return root, leaderboard_bytes(micro_run(root))


@pytest.mark.slow
def test_a_second_run_computes_nothing(finished: tuple[Path, bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    root, table = finished

    def refuse(root: str, job: Job) -> str:
        raise AssertionError(f"{job.stage} {job.label} was run again")

    monkeypatch.setattr(execution, "run_job", refuse)
    again = micro_run(root)
    assert leaderboard_bytes(again) == table
    assert all(again.store.has(job.key) for job in [*again.episodes, *again.signals, *again.learners])


@pytest.mark.slow
def test_one_worker_and_two_write_the_same_bytes(finished: tuple[Path, bytes], tmp_path: Path) -> None:
    root, table = finished
    two = micro_run(tmp_path, workers=2)
    assert leaderboard_bytes(two) == table
    one = Store(root)
    assert one.keys() == two.store.keys()
    for key in one.keys():
        assert files_of(one, key) == files_of(two.store, key), key


@pytest.mark.slow
def test_fitted_signals_and_ensembles_are_recorded_and_driven_alike(tmp_path: Path) -> None:
    run = Run(NOVEL, replace(MICRO, learners=2), Store(tmp_path), workers=2)
    cell = run.task.paper_cell
    for trained in run.trained:
        assert len(trained.keys) == 3, "the learner, its fits, the other learner"
        table = run.tables_of(trained.seed, cell).load(run.store, run.task, cell)["test"]
        assert set(table.signals) == set(NOVEL.signals)
        env = stages.make_env(run.task, cell)
        learner, signals = trained.learner(run.task), trained.signals(run.task)
        for row, seed in enumerate(table.seeds):  # in this process, one after the other
            episode = run_episode(env, learner, signals, NeverSwitch(), None, int(seed))
            for name, trace in episode.signals.items():
                np.testing.assert_array_equal(trace, table.signals[name][row], err_msg=name)
            assert np.nanmin(episode.signals["ensemble"]) > 0 and np.nanmin(episode.signals["mahalanobis"]) > 0


def files_of(store: Store, key: str) -> dict[str, bytes]:
    """Contents of a result; Minari's HDF5 files and the recipe hold the time at which they were written."""
    folder = store.folder(key)
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    skipped = ("key.json", "main_data.hdf5", "metadata.json")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files if path.name not in skipped}


INTERRUPTED = """
import sys
from pathlib import Path
from typing import Any
from micro import leaderboard_bytes, micro_run
if __name__ == "__main__":
    leaderboard_bytes(micro_run(Path(sys.argv[1]), workers=2))
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs process groups")
def test_after_a_kill_in_the_middle_a_rerun_ends_with_the_same_bytes(
    finished: tuple[Path, bytes], tmp_path: Path
) -> None:
    _, table = finished
    root, script = tmp_path / "store", tmp_path / "interrupted.py"
    script.write_text(INTERRUPTED)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    process = subprocess.Popen([sys.executable, str(script), str(root)], env=environment, start_new_session=True)
    try:
        deadline = time.monotonic() + 1800  # a hang, not a slow machine
        while not (found := list(root.glob("table-*"))):  # the first table is there, others are being computed
            assert process.poll() is None and time.monotonic() < deadline, "the run ended before it could be killed"
            time.sleep(0.02)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    left = list((root / ".writing").glob("*"))
    assert len(found) < 4 and left, "it was killed while it was writing"
    run = micro_run(root)
    assert leaderboard_bytes(run) == table
    assert not list((root / ".writing").glob("*")), "what the killed processes left is removed"


def note(folder: Path, text: str) -> None:
    (folder / "note.txt").write_text(text)


def test_a_stage_of_several_tasks_is_one_queue_and_is_shown_once(tmp_path: Path, capsys: Any) -> None:
    store = Store(tmp_path)
    runs = [Run(replace(TASK, name=name), MICRO, store, workers=2) for name in ("first", "second")]
    jobs = {
        run: [
            Job(
                "note",
                f"{run.task.name} {index}",
                store.key("note", {"run": run.task.name, "n": index}, [], []),
                note,
                (str(index),),
            )
            for index in range(count)
        ]
        for run, count in zip(runs, (3, 1), strict=True)
    }
    execution.finish("training", jobs)
    assert capsys.readouterr().err.startswith("first, second training: 4 to do ... done in")
    assert [(run.jobs["training"], run.seconds["training"] > 0) for run in runs] == [(3, True), (1, True)]
    assert runs[0].work["training"] == sum(store.recipe(job.key)["seconds"] for job in jobs[runs[0]])
    assert {(store.folder(job.key) / "note.txt").read_text() for each in jobs.values() for job in each} == {
        "0",
        "1",
        "2",
    }
    runs[0].finish("training", jobs[runs[0]])
    execution.finish("training", jobs)
    assert capsys.readouterr().err == "", "nothing is left to do, and it was shown before"
    Run(TASK, MICRO, store).finish("training", jobs[runs[1]])
    assert "training: kept from before" in capsys.readouterr().err


@pytest.mark.parametrize(("given", "seen"), [(None, "1"), ("2", "2")])
def test_workers_draw_in_their_own_thread_unless_told_otherwise(
    monkeypatch: pytest.MonkeyPatch, given: str | None, seen: str
) -> None:
    """Mesa's own threads would fight over the cores that the workers are on."""
    name = "LP_NUM_THREADS"
    monkeypatch.setenv(name, given or "")
    if given is None:
        monkeypatch.delenv(name)
    get_reusable_executor().shutdown()  # its workers were born before
    with execution.processes(2):
        assert Parallel()(delayed(os.environ.get)(name) for _ in range(4)) == [seen] * 4
    assert os.environ.get(name) == given
    get_reusable_executor().shutdown()


def test_a_run_computes_stages_only_when_they_are_asked_for(tmp_path: Path) -> None:
    run: Run = micro_run(tmp_path)
    assert run.store.keys() == [] and run.seconds == {}
    assert run.task_info.horizon > 0 and run.store.keys() == []
