"""A policy trained with PPO on the switching problem: latched, deterministic, and it learns."""

from __future__ import annotations

import random
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from safeswitch import registry, suite
from safeswitch.handover.panel import Panel
from safeswitch.handover.table import HandoverTable
from safeswitch.protocols import Calibrated, Driver
from safeswitch_baselines.rules.ppo import LARGEST, PolicyRule, PPORule, Scale
from synthetic import calibration, cliff_table, random_table

STANDARD = Scale(np.zeros(1), np.ones(1))


def linear(slope: float, bias: float, history: int = 3) -> PolicyRule:
    """Prefers the expert where slope x log(newest signal) + bias > 0."""
    weight = np.zeros((2, history))
    weight[1, -1] = slope
    return PolicyRule(("total",), STANDARD, [(weight, np.array([0.0, bias]))], history)


def test_a_policy_that_is_a_threshold_hands_over_where_the_threshold_does() -> None:
    for seed in range(20):
        panel = Panel(random_table(seed), "start")
        expected = panel.handover_at("total", np.array([2.5]))[0]
        np.testing.assert_array_equal(panel.handover_of(linear(1.0, -np.log(2.5))), expected)


def test_the_expert_is_final_and_reset_forgets() -> None:
    rule = linear(1.0, -np.log(2.0))
    for _ in range(2):
        rule.reset(0)
        assert rule.arm(0) is Driver.LEARNER
        drivers = [rule.update(step, {"total": value}) for step, value in enumerate((1.0, 3.0, 1.0))]
        assert drivers == [Driver.LEARNER, Driver.EXPERT, Driver.EXPERT]


def test_the_scale_standardises_logarithms() -> None:
    table = random_table(0, 20, False)
    table.signals["total"][:] = np.exp(np.random.default_rng(0).normal(2.0, 0.5, table.signals["total"].shape))
    scale = Scale.fit(table, ("total",))
    logs = scale(table.signals["total"][..., None])
    assert abs(logs.mean()) < 0.02 and logs.std() == pytest.approx(1.0, abs=0.02)
    assert np.isfinite(scale(np.array([[0.0], [-1.0], [1e300]]))).all()


def test_without_the_extra_it_is_left_out_and_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite, "find_spec", lambda module: None)
    assert "ppo@signals" not in suite.methods(("total",))
    assert "pip install 'safeswitch[rl]'" in suite.without_extra()["ppo@signals"]
    monkeypatch.setitem(__import__("sys").modules, "stable_baselines3", None)
    with pytest.raises(ValueError, match=r"safeswitch\[rl\]"):
        PPORule("signals").calibrate(calibration(cliff_table(0.3), cliff_table(0.3, disturbed=False), "onset"))


def train(arming: str, seed: int = 0) -> tuple[Calibrated, Panel]:
    """A policy for the cliff, and other episodes to test it on.

    The cliff, a factor of 20 above the undisturbed signal, is within what the policy is shown (`LARGEST` standard
    deviations), and its time differs so much between episodes that it takes the signal to earn more than a timer.
    """
    assert np.log(20) < 0.75 * LARGEST
    make = partial(cliff_table, 0.3, noise=0.75, rates=(0.025, 0.1))

    def split(seed: int) -> tuple[HandoverTable, HandoverTable]:
        return make(seed=seed), make(disturbed=False, seed=seed)

    calibrated = registry.make_method("ppo@signals").calibrate(calibration(*split(0), arming, seed))  # type: ignore[arg-type]
    return calibrated, calibration(*split(1), arming).panel  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize("arming", ["onset", "start"])
def test_it_learns_to_hand_over_before_the_cliff(arming: str) -> None:
    pytest.importorskip("stable_baselines3")
    state = np.random.get_state()[1].copy(), random.getstate()
    calibrated, panel = train(arming)
    assert (np.random.get_state()[1] == state[0]).all() and random.getstate() == state[1], "global generators as before"
    handover = panel.handover_of(calibrated.rule)
    assert panel.success(handover).mean() > 0.9
    assert panel.returns(handover).mean() > panel.trivial_return()
    assert calibrated.tuning_episodes > 0 and calibrated.expert_queries > 0

    again, _ = train(arming)
    other, _ = train(arming, seed=1)
    for (weight, _), (same, _), (different, _) in zip(
        calibrated.rule.layers, again.rule.layers, other.rule.layers, strict=True
    ):
        np.testing.assert_array_equal(weight, same)
        assert (weight != different).any()
    renamed = replace(panel.table, seeds=panel.table.seeds + 1)
    np.testing.assert_array_equal(Panel(renamed, panel.arming).handover_of(calibrated.rule), handover)


def test_it_is_left_out_where_every_episode_ends_before_the_rule_is_armed() -> None:
    early = random_table(0)
    early = replace(early, onset=early.length.copy())
    assert PPORule("signals").calibrate(calibration(early, random_table(1, 6, False), "onset")).rule is None
