"""Rules that give control back: hysteresis, dwell, and what each asks the expert for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safeswitch import registry, stages, suite
from safeswitch.handover.episode import DEVIATION, NeverSwitch, run_episode
from safeswitch.handover.panel import Panel
from safeswitch.protocols import Driver
from safeswitch_baselines.learners.bayesian import BayesianLearner
from safeswitch_baselines.rules.gates import EnsembleGate, LazyGate, SafetyGate
from safeswitch_baselines.rules.give_back import DWELL, DwellOnSignal
from safeswitch_baselines.rules.risk import RiskCritic
from safeswitch_baselines.signals.discrepancy import TAU
from synthetic import calibration, cliff_table, random_calibration

L, E = Driver.LEARNER, Driver.EXPERT


def drive(rule: Any, values: Any, deviation: Any = 1.0, signal: str = "total") -> list[Driver]:
    """Driver after each step; the deviation is known at every step."""
    rule.reset(0)
    rule.arm(0)
    pairs = zip(values, np.broadcast_to(deviation, len(values)), strict=True)
    return [rule.update(t, {signal: float(v), DEVIATION: float(d)}) for t, (v, d) in enumerate(pairs)]


def changes(drivers: list[Driver]) -> int:
    return int(np.sum(np.diff([int(each) for each in [L, *drivers]]) != 0))


def test_safe_dagger_follows_the_classifier_step_by_step() -> None:
    p = np.random.default_rng(0).random(200)
    assert drive(SafetyGate("total"), p) == [E if each > 0.5 else L for each in p]


def test_lazy_gives_back_only_when_the_learner_agrees_with_the_expert() -> None:
    gate = LazyGate("total", 0.02)
    assert drive(gate, [0.9, 0.1, 0.1, 0.1], deviation=[0.0, 0.03, 0.02, 0.01]) == [E, E, E, L]
    assert drive(gate, [0.4, 0.9, 0.9, 0.4], deviation=0.5) == [L, E, E, E]


@pytest.mark.parametrize("value", [0.0, 0.5, 0.51, 1.0])
@pytest.mark.parametrize("deviation", [0.05, 1.0])
def test_hysteresis_never_chatters_on_a_constant_signal(value: float, deviation: float) -> None:
    """Between the two bounds of the deviation, a constant signal leads to one change at most; SafeDAgger's also."""
    assert changes(drive(LazyGate("total", 0.02), [value] * 100, deviation)) <= 1
    assert changes(drive(SafetyGate("total"), [value] * 100, deviation)) <= 1
    assert changes(drive(DwellOnSignal("total", 0.5, 0.3), [value] * 100)) <= 1


def test_hysteresis_changes_no_more_often_than_the_gate_without() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        p, deviation = rng.random(300), rng.uniform(0, 0.05, 300)
        assert changes(drive(LazyGate("total", 0.01), p, deviation)) < changes(drive(SafetyGate("total"), p))


def test_ensemble_dagger_lets_the_learner_drive_where_doubt_and_deviation_are_both_low() -> None:
    doubt, deviation = np.meshgrid([0.1, 0.3], [0.01, 0.2])
    found = drive(EnsembleGate("total", 0.2, TAU), doubt.ravel(), deviation.ravel())
    assert found == [L, E, E, E]


def test_dwell_gives_back_after_consecutive_low_steps() -> None:
    rule = DwellOnSignal("total", 1.0, 0.2)
    low = [0.1] * (DWELL - 1)
    assert drive(rule, [2.0, *low]) == [E] * DWELL
    assert drive(rule, [2.0, *low, 0.1])[-1] is L
    assert E == drive(rule, [2.0, *low, 0.5, *low])[-1], "a step between the thresholds starts the count again"
    assert drive(rule, [0.5] * 50) == [L] * 50


@pytest.mark.parametrize("rule", ["safe-dagger", "lazy"])
def test_gates_on_the_classifier_refuse_other_signals(rule: str) -> None:
    with pytest.raises(ValueError, match=f"write '{rule}@discrepancy'"):
        registry.make_method(f"{rule}@total")


def test_needs_are_declared() -> None:
    needs = {name: registry.make_method(name).needs for name in ("ensemble-dagger@epistemic", "lazy@discrepancy")}
    assert needs["ensemble-dagger@epistemic"] >= {"expert-queries", "privileged"}
    assert "expert-queries" not in needs["lazy@discrepancy"], "it only looks at what the expert does while it drives"


def test_risk_tells_failing_episodes_from_others_and_is_one_function() -> None:
    chosen = calibration(cliff_table(0.12), cliff_table(0.12, disturbed=False), "start")
    critic = RiskCritic.fit(chosen.panel)
    fresh = calibration(cliff_table(0.12, seed=5), cliff_table(0.12, disturbed=False, seed=6), "start").panel
    risks = critic.risks(fresh)
    last = risks[:, -1]
    assert (last[fresh.table.disturbed] > 0.9).all() and (last[~fresh.table.disturbed] < 0.2).all()
    for episode, step in [(0, 0), (3, 40), (70, 79)]:
        one = critic.risk(step, {"total": float(fresh.signal("total")[episode, step])})
        assert one == pytest.approx(risks[episode, step], rel=1e-9)


def test_risk_is_calibrated_on_its_own_steps() -> None:
    """The score equation of a logistic regression with a constant: predicted failures add up to the observed ones."""
    panel: Panel = random_calibration(3, "start", ("total", "epistemic")).panel
    risks = RiskCritic.fit(panel).risks(panel)
    labels = np.where(np.isnan(risks), np.nan, ~panel.table.learner_success[:, None])
    assert np.nanmean(risks) == pytest.approx(np.nanmean(labels), abs=1e-4)


class Watch(NeverSwitch):
    """Hands over for some steps and writes down what it is told."""

    def __init__(self, expert: range):
        self.expert = expert

    def reset(self, seed: int) -> None:
        self.told: dict[int, float] = {}

    def update(self, step: int, signals: Any) -> Driver:
        if DEVIATION in signals:
            self.told[step] = signals[DEVIATION]
        return E if step + 1 in self.expert else L


def test_the_deviation_is_known_where_the_expert_drives_and_everywhere_with_an_adviser(tiny_learner: Path) -> None:
    task = suite.task("cart-pole")
    env = stages.make_env(task, task.none_cell)
    learner, expert, adviser = BayesianLearner.load(tiny_learner), env.make_expert(), env.make_expert()
    rule = Watch(range(10, 20))
    alone = run_episode(env, learner, [], rule, expert, 3)
    assert sorted(rule.told) == list(range(10, 20))
    known = dict(rule.told)
    advised = run_episode(env, learner, [], rule, expert, 3, adviser=adviser)
    np.testing.assert_array_equal(advised.actions, alone.actions)
    assert sorted(rule.told) == list(range(advised.length))
    assert {step: rule.told[step] for step in known} == known
    again = dict(rule.told)
    run_episode(env, learner, [], rule, expert, 3, adviser=adviser)
    assert rule.told == again, "a function of the episode"
    env.reset(seed=3)  # the first advice is a cold start from the first state
    learner.reset(3)
    adviser.reset()
    first = np.abs(learner.predict(env.observe(), 0).action - adviser.action(env.state, env.parameters))[0]
    assert again[0] == pytest.approx(first)
    env.close()
