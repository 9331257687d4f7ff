"""Learners, rules and signals from outside: a temporary module on the search path, as an outsider has it."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from micro import MICRO, TASK, micro_run
from safeswitch import factories, registry, stages, suite
from safeswitch.evaluation import check_rule, check_signals, evaluate, score_rows, with_method
from safeswitch.handover.panel import Panel
from safeswitch.pipeline import Run
from safeswitch.protocols import Learner, LearnerFactory, Method, Prediction, SwitchRule
from safeswitch.store import Store
from synthetic import random_calibration, random_table

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"

OUTSIDER = '''
"""Written against docs/add_a_learner.md and docs/add_a_rule.md alone; imports nothing of the benchmark."""
import numpy as np
from types import SimpleNamespace

GAIN = np.array([-0.02, -0.03, 0.1, 0.03])

class Linear:
    def __init__(self, gain): self.gain = gain
    def reset(self, seed): pass
    def predict(self, observation, step):
        nothing = np.full(1, np.nan)
        action = np.clip(np.array([float(self.gain @ observation)]), -1, 1)
        return SimpleNamespace(action=action, epistemic_var=nothing, aleatoric_var=nothing, features=None)

def ready(): return Linear(GAIN)
def seeded(seed): return Linear(GAIN * (1 + seed))
def trained(demonstrations, seed):
    x, y = np.asarray(demonstrations.observations, float), demonstrations.actions[:, 0]
    return Linear(np.linalg.lstsq(x, y, rcond=None)[0])
def moody(demonstrations): return Linear(GAIN * np.random.rand())
def greedy(weights): return Linear(weights)
def wrong_shape(): return Linear(np.ones((3, 4)))
NUMBER = 3

class Kept(Linear):
    @classmethod
    def train(cls, demonstrations, seed, options):
        return cls(trained(demonstrations, seed).gain)
    def save(self, folder):
        folder.mkdir()
        np.save(folder / "gain.npy", self.gain)
    @classmethod
    def load(cls, folder):
        return cls(np.load(folder / "gain.npy"))

class Lean:
    """A signal: how far the pole leans."""
    id = "lean"
    def reset(self): pass
    def update(self, observation, prediction, previous_action): return float(abs(observation[2]))

class Falling:
    """A bare rule on that signal: the expert (1) takes over when the pole leans back from upright."""
    reads = ("outsider:Lean",)
    def reset(self, seed): self.low, self.driver = np.inf, 0
    def arm(self, step): return 0
    def update(self, step, signals):
        lean = signals["outsider:Lean"]
        self.low = min(self.low, lean)
        if lean > self.low + 0.3: self.driver = 1
        return self.driver

class Fickle(Falling):
    def update(self, step, signals): return step % 2

class GivesBack(Fickle):
    latched = False

class Liar(Falling):
    def handover_steps(self, panel): return panel.table.onset

class Peeks:
    def __init__(self): pass
    id, needs, latched = "peeks", frozenset(), True
    def calibrate(self, calibration):
        from safeswitch.protocols import Calibrated
        return Calibrated(SimpleNamespace(handover_steps=lambda panel: panel.table.onset))

class NoRule: pass
'''


@pytest.fixture
def outsider(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the module `outsider`, on the search path of this process and of its workers."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "outsider.py").write_text(OUTSIDER)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("PYTHONPATH", str(folder))
    monkeypatch.delitem(sys.modules, "outsider", raising=False)
    return folder


def env() -> Any:
    return stages.make_env(TASK, TASK.none_cell)


def trained(folder: Path, name: str, dataset: tuple[str, str] = ("", ""), seed: int = 0) -> Any:
    """The learner `name`, made and made again as another process would."""
    folder.mkdir(parents=True)
    factories.train(folder, name, env(), *dataset, seed, {})
    return factories.load(name, folder, env)


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    from safeswitch import demos

    store = tmp_path_factory.mktemp("store")
    demos.collect(TASK.env_id, TASK.dataset, store / "demonstrations-1", range(2), n_jobs=1)
    return store, TASK.dataset


@pytest.mark.parametrize("name", ["outsider:ready", "outsider:seeded", "outsider:trained", "outsider:Kept"])
def test_every_kind_of_factory_makes_the_same_learner_again(
    outsider: Path, demonstrations: tuple[Path, str], name: str
) -> None:
    store, dataset = demonstrations
    wants = factories.wants_demonstrations(name)
    assert wants == (name in ("outsider:trained", "outsider:Kept"))
    folder = store / f"learner-{name.partition(':')[2]}"
    again = trained(folder, name, (dataset, str(store / "demonstrations-1")) if wants else ("", ""), seed=2)
    import outsider as module  # type: ignore[import-not-found]

    gain = {"ready": module.GAIN, "seeded": 3 * module.GAIN}.get(name.partition(":")[2])
    if gain is not None:
        np.testing.assert_array_equal(again.gain, gain)
    assert isinstance(again, Learner) and (folder / "factory.json").is_file() == (name != "outsider:Kept")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("outsider:greedy", "asks for 'weights'; a factory may ask for demonstrations and seed"),
        ("outsider:NUMBER", "is a int: it must be a function"),
        ("outsider:wrong_shape", "finite numbers|only .* can be converted"),
        ("outsider:NoRule", "has no method 'reset'"),
        ("outsider:nothing", "cannot be imported"),
        ("no_such_module:make", "cannot be imported"),
    ],
)
def test_a_learner_that_cannot_take_part_is_refused_with_the_reason(
    outsider: Path, tmp_path: Path, name: str, message: str
) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        trained(tmp_path / "learner", name)


def test_a_factory_that_makes_another_learner_each_time_is_refused(
    outsider: Path, demonstrations: tuple[Path, str]
) -> None:
    store, dataset = demonstrations
    with pytest.raises(ValueError, match="made twice and predicts two things"):
        trained(store / "learner-moody", "outsider:moody", (dataset, str(store / "demonstrations-1")))


def test_new_weights_of_a_ready_made_learner_are_a_new_learner(outsider: Path, tmp_path: Path) -> None:
    import outsider as module  # type: ignore[import-not-found]

    task, keys = replace(TASK, learner="outsider:ready", learner_options={}), []
    for _ in range(2):
        job = stages.learner_job(Store(tmp_path), task, replace(MICRO, learner_options={}), 0, None)
        keys.append(job.key)
        module.GAIN = 2 * module.GAIN  # as a new file of weights would: the source is the same
    assert keys[0] != keys[1]


def test_a_bare_rule_is_a_method_and_methods_are_called_with_their_signal(outsider: Path) -> None:
    method = registry.make_method("outsider:Falling")
    assert isinstance(method, Method) and method.latched and method.needs == frozenset()
    assert method.reads == ("outsider:Lean",)
    assert not registry.make_method("outsider:GivesBack").latched
    assert registry.make_method("safeswitch_baselines.rules.cem:CEM@total").id == "cem@total"
    for name, message in (
        ("outsider:NoRule", "without reset and arm and update"),
        ("outsider:Falling@total", "write outsider:Falling without a signal"),
        ("safeswitch_baselines.rules.cem:CEM", "write safeswitch_baselines.rules.cem:CEM@total"),
        ("outsider:NUMBER", "is a int"),
    ):
        with pytest.raises(ValueError, match=message):
            registry.make_method(name)


def test_signals_from_outside_are_made_smoothed_and_named_as_they_were_asked_for(outsider: Path) -> None:
    for name in ("outsider:Lean", "outsider:Lean-max3"):
        signal = registry.make_signal(name)
        assert signal.id == name and registry.base_signal(name) == "outsider:Lean"


def test_what_is_recorded_is_what_the_method_reads(outsider: Path, tmp_path: Path) -> None:
    run = micro_run(tmp_path)

    def task_of(method_id: str, learner: str | None, *signals: str) -> Any:
        return with_method(run, registry.make_method(method_id), method_id, learner, signals).task

    assert task_of("outsider:Falling", "outsider:ready").signals == ("outsider:Lean",)
    assert task_of("cem@total-mean3", "outsider:ready", "epistemic").signals == ("total-mean3", "epistemic")
    assert task_of("timer", "outsider:ready").signals == ()
    assert task_of("outsider:Falling", None).signals == (*TASK.signals, "outsider:Lean")
    assert task_of("cem@total", None) == run.task, "the suite's own: what bench has computed is used"
    assert task_of("timer", "outsider:ready").learner_options == {}
    with pytest.raises(ValueError, match="needs learners of several seeds"):
        task_of("cem@ensemble", "outsider:ready")
    with pytest.raises(ValueError, match="unknown signal 'totl'; valid, nearest first: total"):
        task_of("cem@totl", "outsider:ready")


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        ("outsider:Fickle", "gives control back .* say so with `latched = False`"),
        ("outsider:Liar", "contradicts itself in episode"),
        ("outsider:Peeks", "add 'privileged' to its needs"),
    ],
)
def test_rules_that_are_not_what_they_say_are_refused(outsider: Path, rule: str, message: str) -> None:
    panel = Panel(random_table(3, 20, signals=("outsider:Lean",)), "onset")
    method = registry.make_method(rule)
    calibrated = method.calibrate(None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=message):
        check_rule(rule, method, calibrated, panel)
    honest = registry.make_method("outsider:Falling")
    check_rule("outsider:Falling", honest, honest.calibrate(None), panel)  # type: ignore[arg-type]


def test_a_signal_without_a_value_is_refused(outsider: Path) -> None:
    assert np.isnan(Prediction(np.zeros(2)).epistemic_var).all(), "only the action is required"
    table = random_table(0, signals=("total",))
    check_signals(TASK, [table])
    with pytest.raises(ValueError, match="'total' has no value"):
        check_signals(TASK, [table.with_signal("total", np.full_like(table.signals["total"], np.nan))])


def test_the_examples_satisfy_the_protocols(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    method = registry.make_method("my_rule:RisingSignal@total")
    assert isinstance(method, Method)
    assert isinstance(registry.find("learner", "bayesian-mlp"), LearnerFactory)
    panel = Panel(random_table(1, 10), "onset")
    calibrated = method.calibrate(random_calibration(1, "onset"))
    assert isinstance(calibrated.rule, SwitchRule)
    check_rule("my_rule:RisingSignal@total", method, calibrated, panel)


def test_scores_are_shown_with_their_intervals_and_none_is_left_out() -> None:
    scores = {"task": "cart-pole", "method": "timer", "return_mean": 5.25, "return_lo": 5.125, "return_hi": 5.5}
    scores |= {"skill": np.nan, "skill_lo": np.nan, "skill_hi": np.nan, "missed": 3, "calibrated_on": ""}
    assert score_rows(scores) == [("return_mean", "5.25", "5.125 to 5.5"), ("skill", "–", ""), ("missed", "3", "")]


def test_what_is_no_task_is_refused(outsider: Path) -> None:
    with pytest.raises(ValueError, match="is a int, not a safeswitch.suite.Task"):
        suite.task("outsider:NUMBER")
    with pytest.raises(ValueError, match="unknown task 'cart-pol'; valid, nearest first: cart-pole"):
        suite.task("cart-pol")


@pytest.mark.slow
def test_a_learner_and_rule_from_outside_are_scored(outsider: Path, tmp_path: Path) -> None:
    run = Run(TASK, MICRO, Store(tmp_path / "store"), 1)
    for rule in ("outsider:Falling", "outsider:GivesBack", "timer"):
        found = evaluate(run, rule, protocol="start", learner="outsider:ready")
        assert found.scores["episodes"] == 4 and 0 <= found.scores["autonomy"] <= 1
        assert found.run.profile.learners == 1 and found.run.task.learner == "outsider:ready"
        assert set(found.episodes["method"]) == {"learner", "expert", "timer", rule}
    with pytest.raises(ValueError, match="'total' has no value"):
        evaluate(run, "cem@total", learner="outsider:ready")
    assert not [key for key in run.store.keys() if key.startswith("demonstrations")], "a ready-made learner needs none"


NO_TORCH = "raise ImportError('torch is not here')\n"


@pytest.mark.slow
def test_the_suite_needs_no_torch_to_score_a_numpy_learner(tmp_path: Path) -> None:
    blocked, elsewhere = tmp_path / "blocked", tmp_path / "elsewhere"
    (blocked / "torch").mkdir(parents=True)
    (blocked / "torch" / "__init__.py").write_text(NO_TORCH)
    elsewhere.mkdir()
    for name in ("numpy_learner.py", "my_rule.py"):
        (elsewhere / name).write_text((EXAMPLES / name).read_text())
    path = os.pathsep.join(map(str, (blocked, elsewhere)))
    environment = {**os.environ, "PYTHONPATH": path, "COLUMNS": "120"}
    refused = subprocess.run([sys.executable, "-c", "import torch"], env=environment, capture_output=True)
    assert refused.returncode != 0
    command = [Path(sys.executable).parent / "safeswitch", "evaluate", "--profile", "smoke", "--task", "cart-pole"]
    options = ["--jobs", "2", "--store", tmp_path / "store", "--learner", "numpy_learner:make"]
    rule = ["--rule", "my_rule:RisingSignal@total", "--disturbance", "cart-mass", "--protocol", "start"]
    done = subprocess.run([*command, *options, *rule], env=environment, cwd=elsewhere, capture_output=True, text=True)
    assert done.returncode == 0, textwrap.indent(done.stdout + done.stderr, "  ")
    assert "numpy_learner:make" in done.stdout and "return_mean" in done.stdout
