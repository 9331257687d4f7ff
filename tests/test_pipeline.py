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
from pathlib import Path

import pytest

from micro import MICRO, TASK, leaderboard_bytes, micro_run
from safeswitch import pipeline, stages
from safeswitch.pipeline import Run
from safeswitch.stages import CellTables, Job
from safeswitch.store import Store

PASSIVE = {
    "safeswitch",  # registers the ids
    "safeswitch.files",
    "safeswitch.names",
    "safeswitch.protocols",
    "safeswitch.registry",
    "safeswitch.tasks",  # chooses the rendering backend
    "safeswitch.tasks.checks",  # errors alone
    "safeswitch.tasks.rendering",  # pictures alone: an image task names it in its `modules`
}
"""Modules that a stage may use without depending on their content: no number of a result comes from them."""


def jobs_of(store: Store) -> dict[str, Job]:
    """One job of each stage, with its key; nothing is run."""
    cell = TASK.paper_cell
    demonstrations = stages.demonstrations_job(store, TASK, MICRO)
    learner = stages.learner_job(store, TASK, MICRO, 0, demonstrations)
    keys = {
        (each, split): tuple(job.key for job in stages.table_jobs(store, TASK, each, split, 2, learner))
        for each in (cell, TASK.none_cell)
        for split in ("calibrate", "test")
    }
    tables = CellTables(
        keys[cell, "calibrate"], keys[TASK.none_cell, "calibrate"], keys[cell, "test"], keys[TASK.none_cell, "test"]
    )
    table = stages.table_jobs(store, TASK, cell, "test", 2, learner)[0]
    episodes = stages.episodes_job(store, TASK, cell, 0, learner, tables, give_back=False)
    signals = stages.signals_job(store, TASK, cell, 0, tables)
    scores = pipeline.publish.scores_job(store, TASK, None, [episodes], [signals])  # type: ignore[arg-type]
    spread = pipeline.publish.spread_job(store, TASK, 0, tables)
    figures = pipeline.publish.figures_job(store, TASK, learner, episodes, tables, scores)
    every = (demonstrations, learner, table, episodes, signals, scores, spread, figures)
    return {job.stage: job for job in every}


def edited(module: str) -> type[Store]:
    """A store that finds the source of `module` (or of a file of a package) changed."""

    class Edited(Store):
        def _hashes(self, code):
            return [(name, sha + "-edited" if name == module else sha) for name, sha in super()._hashes(code)]

    return Edited


@pytest.mark.parametrize(
    ("module", "run_again"),
    [
        ("safeswitch_baselines.rules/cem.py", {"episodes", "scores", "spread", "figures"}),
        ("safeswitch_baselines.rules/thresholds.py", {"episodes", "scores", "spread", "figures"}),
        ("safeswitch.handover.panel", {"episodes", "scores", "spread", "figures"}),
        ("safeswitch.scoring/metrics.py", {"scores", "figures"}),
        ("safeswitch.scoring.figures", {"figures"}),
        ("safeswitch.scoring.signal_quality", {"signals", "scores", "figures"}),
        ("safeswitch.handover.episode", {"table", "episodes", "signals", "scores", "spread", "figures"}),
        ("safeswitch_baselines.signals", {"table", "episodes", "signals", "scores", "spread", "figures"}),
        (
            "safeswitch_baselines.learners/networks.py",
            {"learner", "table", "episodes", "signals", "scores", "spread", "figures"},
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


def imports_of(module: str) -> Iterator[str]:
    """Modules of the suite that the source of `module` imports, type checking aside."""
    spec = importlib.util.find_spec(module)
    assert spec is not None and spec.origin is not None
    tree = ast.parse(Path(spec.origin).read_text())
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

    monkeypatch.setattr(pipeline, "run_job", refuse)
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


def files_of(store: Store, key: str) -> dict[str, bytes]:
    """Contents of a result; Minari's HDF5 files and the recipe hold the time at which they were written."""
    folder = store.folder(key)
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    skipped = ("key.json", "main_data.hdf5", "metadata.json")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files if path.name not in skipped}


INTERRUPTED = """
import sys
from pathlib import Path
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


def test_a_run_computes_stages_only_when_they_are_asked_for(tmp_path: Path) -> None:
    run: Run = micro_run(tmp_path)
    assert run.store.keys() == [] and run.seconds == {}
    assert run.task_info.horizon > 0 and run.store.keys() == []
