"""The one list of tasks, cells, splits, seeds, methods and profiles: unique, complete, clear about unknown names."""

from __future__ import annotations

import gymnasium as gym
import pytest

from safeswitch import evaluate, registry, scoring_stages, stages, suite
from safeswitch.suite import SPLIT_SIZE, SPLITS, Cell, Task, episode_seeds
from safeswitch.tasks.disturbances import SEVERITIES, offered

TASKS = list(suite.TASKS.values())
CELLS = [cell for task in TASKS for cell in task.cells]
METHODS = [name for task in TASKS for name in suite.methods(task.signals)]


def test_splits_never_share_a_seed() -> None:
    for index, split in enumerate(SPLITS):
        first, last = episode_seeds(split, 1)[0], episode_seeds(split, 1, SPLIT_SIZE - 1)[0]
        assert (first, last) == (index * SPLIT_SIZE, (index + 1) * SPLIT_SIZE - 1)
    seeds = [seed for split in SPLITS for seed in episode_seeds(split, 1000)]
    assert len(set(seeds)) == len(seeds)


def test_chunks_of_a_split_are_the_split() -> None:
    whole = episode_seeds("test", 50)
    assert whole == [*episode_seeds("test", 20), *episode_seeds("test", 20, 20), *episode_seeds("test", 10, 40)]


@pytest.mark.parametrize(("count", "first"), [(1, -1), (-1, 0), (1, SPLIT_SIZE), (SPLIT_SIZE + 1, 0)])
def test_seeds_outside_a_split_are_refused(count: int, first: int) -> None:
    with pytest.raises(ValueError, match=f"0 .. {SPLIT_SIZE - 1}"):
        episode_seeds("test", count, first)


def test_names_are_unique() -> None:
    assert len({str(cell) for cell in CELLS}) == len(CELLS)
    for task in TASKS:
        methods = suite.methods(task.signals)
        assert len(set(methods)) == len(methods)
        assert len(set(task.signals)) == len(task.signals)
    for table in (suite.TASKS, suite.PROFILES):
        assert all(name == each.name for name, each in table.items())


@pytest.mark.parametrize("cell", CELLS, ids=str)
def test_every_cell_is_of_its_task(cell: Cell) -> None:
    task = suite.task(cell.task)
    track = {"track": cell.track} if cell.track else {}
    if cell.tag == "none":
        assert (cell.disturbance, cell.severity, cell.env_kwargs) == ("none", 0, track)
    else:
        assert cell.disturbance in offered(task.name) and cell.severity in SEVERITIES
        assert cell.env_kwargs == {"disturbance": cell.disturbance, "severity": cell.severity, **track}
    env = stages.make_env(task, cell)
    env.reset(seed=0)
    assert (env.onset is None) == (cell.tag == "none")
    env.close()


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.name)
def test_every_task_has_the_cells_that_a_comparison_needs(task: Task) -> None:
    paper, none, benign = task.cells[:3]  # what the smaller profiles run
    assert (paper.tag, paper.severity, none.tag, benign.tag) == ("paper", 3, "none", "benign")
    assert task.paper_cell == paper and task.none_cell == none
    assert {cell.severity for cell in task.cells if cell.tag == "paper"} == set(SEVERITIES)
    assert len({cell.disturbance for cell in task.cells if cell.tag == "other"}) >= 4
    gym.spec(task.env_id)
    for kind, names in (("learner", [task.learner]), ("signal", [])):
        assert all(registry.find(kind, name) for name in names)
    assert all(registry.find("signal", registry.base_signal(name)).id for name in task.signals)


@pytest.mark.parametrize("cell", CELLS, ids=str)
def test_thresholds_come_from_a_cell_in_which_something_can_be_saved(cell: Cell) -> None:
    task = suite.task(cell.task)
    expected = task.paper_cell if cell.tag in ("none", "benign", "held-out") else cell
    assert task.calibrated_on(cell) == expected
    assert scoring_stages.protocols_of(cell) == (("start",) if cell.tag == "none" else ("onset", "start"))


@pytest.mark.parametrize("profile", suite.PROFILES.values(), ids=lambda profile: profile.name)
def test_every_profile_has_what_calibration_needs(profile: suite.Profile) -> None:
    for task in TASKS:
        cells = profile.cells_of(task)
        assert {task.paper_cell, task.none_cell} <= set(cells)
        assert all(task.calibrated_on(cell) in cells for cell in cells)
    assert min(profile.learners, profile.calibrate, profile.test) >= 1


@pytest.mark.parametrize(
    ("ask", "nearest"),
    [
        (lambda: suite.task("cartpole"), "unknown task 'cartpole'; valid, nearest first: cart-pole"),
        (lambda: suite.profile("smok"), "unknown profile 'smok'; valid, nearest first: smoke"),
        (lambda: episode_seeds("tests", 1), "unknown split 'tests'; valid, nearest first: test"),  # type: ignore
        (lambda: registry.make_method("cemm@total"), "unknown method 'cemm'; valid, nearest first: cem"),
        (lambda: registry.make_method("fixed-q9@total"), "unknown method 'fixed-q9'; valid, nearest first: fixed-q9"),
        (lambda: registry.make_signal("totl-mean3"), "unknown signal 'totl'; valid, nearest first: total"),
        (lambda: registry.find("learner", "bayesian"), "unknown learner 'bayesian'; valid, nearest first: bayes"),
        (
            lambda: evaluate.find_cell(suite.task("cart-pole"), "cart-mas", 3),
            "unknown cell 'cart-pole/cart-mas-3'; valid, nearest first: cart-pole/cart-mass-3",
        ),
        (
            lambda: evaluate.find_cell(suite.task("cart-pole"), "cart-mass", 6),
            "unknown cell 'cart-pole/cart-mass-6'; valid, nearest first: cart-pole/cart-mass-",
        ),
    ],
)
def test_unknown_names_list_the_valid_ones_nearest_first(ask, nearest: str) -> None:
    with pytest.raises(ValueError) as error:
        ask()
    assert str(error.value).startswith(nearest)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("cem", "method 'cem' needs a signal: write 'cem@total'"),
        ("cem@", "method 'cem' needs a signal"),
        ("fixed-0.1", "needs a signal"),
        ("learner@total", "method 'learner' uses no signal, got 'total': write 'learner'"),
        ("no_such_package.rules:Rule", "cannot be imported"),
        ("safeswitch_baselines.rules.cem:NoSuchRule", "cannot be imported"),
    ],
)
def test_ids_that_break_the_grammar_are_errors_that_say_how_to_write_them(name: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        registry.make_method(name)
    assert message in str(error.value)
