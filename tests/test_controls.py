"""Controls: as much expert time as the rule, none of its information."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safeswitch import registry
from safeswitch.handover.panel import Calibration
from safeswitch.protocols import ARMINGS, Driver
from safeswitch_baselines.rules.controls import PERIOD, PeriodicRule, RandomRule, reference_share, shuffled
from synthetic import calibration, cliff_table

EDGE = 0.12


def cliff(arming: Any) -> Calibration:
    return calibration(cliff_table(EDGE), cliff_table(EDGE, disturbed=False), arming)


def drivers(rule: Any, seed: int, start: int, horizon: int) -> np.ndarray:
    """Driver of each step from `start` to T - 1."""
    rule.reset(seed)
    chosen = [rule.arm(start), *(rule.update(step, {}) for step in range(start, horizon - 1))]
    return np.array(chosen)


@pytest.mark.parametrize("arming", ARMINGS)
def test_random_hands_over_for_the_share_of_the_reference(arming: Any) -> None:
    chosen = cliff(arming)
    target, reference = reference_share(chosen)
    found = registry.make_method("random").calibrate(chosen)
    assert 0.05 < target < 0.95 and found.tuning_episodes == reference.tuning_episodes
    panel = chosen.panel
    shares = [
        (drivers(found.rule, 100 * seed + index, int(start), panel.table.horizon) == Driver.EXPERT).mean()
        for seed in range(40)
        for index, start in enumerate(panel.arming_step)
    ]
    error = 3 * np.std(shares) / np.sqrt(len(shares))
    assert error < 0.04 and np.mean(shares) == pytest.approx(target, abs=error)


def test_random_is_latched_blind_and_a_function_of_the_seed() -> None:
    rule = RandomRule(0.1)
    one = drivers(rule, 5, 3, 80)
    np.testing.assert_array_equal(drivers(rule, 5, 3, 80), one)
    assert (np.diff(one.astype(int)) >= 0).all() and one[0] == Driver.LEARNER
    first = [int(np.argmax(drivers(rule, seed, 0, 500) == Driver.EXPERT)) for seed in range(400)]
    assert np.mean(first) == pytest.approx(10, rel=0.15)  # mean of a geometric distribution


@pytest.mark.parametrize("burst", [0, 1, 7, PERIOD])
def test_periodic_bursts_end_every_period_after_the_arming_step(burst: int) -> None:
    start, periods = 13, 3
    pattern = [Driver.LEARNER] * (PERIOD - burst) + [Driver.EXPERT] * burst
    found = drivers(PeriodicRule(burst), 0, start, start + periods * PERIOD)
    np.testing.assert_array_equal(found, pattern * periods)


@pytest.mark.parametrize("arming", ARMINGS)
def test_periodic_has_the_burst_nearest_to_the_share(arming: Any) -> None:
    chosen = cliff(arming)
    share, reference = reference_share(chosen)
    found = registry.make_method("periodic").calibrate(chosen)
    assert abs(found.rule.burst / PERIOD - share) <= 0.5 / PERIOD + 1e-12
    assert found.tuning_episodes == reference.tuning_episodes


@pytest.mark.parametrize("arming", ARMINGS)
def test_shuffled_moves_the_trace_of_another_episode_of_the_kind_to_the_arming_step(arming: Any) -> None:
    panel = cliff(arming).panel
    count, horizon = len(panel), panel.table.horizon
    name_tag = np.arange(count)[:, None] * 1000.0 + np.arange(horizon)  # says which episode and step it is from
    moved = shuffled(panel.with_signal("total", name_tag), "total").signal("total")
    donors = []
    for episode in range(count):
        start = int(panel.arming_step[episode])
        donor, step = divmod(moved[episode, start], 1000)
        donors.append(int(donor))
        assert donor != episode and panel.table.disturbed[int(donor)] == panel.table.disturbed[episode]
        assert step == panel.arming_step[int(donor)], "aligned at the arming step"
        known = np.flatnonzero(~np.isnan(moved[episode]))
        np.testing.assert_array_equal(moved[episode, known] - moved[episode, start], known - start)
        assert known[0] == start
    assert sorted(donors) == list(range(count)), "every trace is used once"


@pytest.mark.parametrize("arming", ARMINGS)
def test_shuffled_changes_signals_only_and_has_its_own_threshold(arming: Any) -> None:
    chosen = cliff(arming)
    panel = chosen.panel
    other = shuffled(panel, "total")
    np.testing.assert_array_equal(other.table.learner_success, panel.table.learner_success)
    np.testing.assert_array_equal(other.arming_step, panel.arming_step)
    own = registry.make_method("shuffled@total").calibrate(chosen)
    cem = registry.make_method("cem@total").calibrate(chosen)
    assert own.tuning_episodes > 0 and own.threshold != cem.threshold
    earned = [panel.returns(panel.handover_of(each.rule)).mean() for each in (own, cem)]
    assert earned[0] < earned[1], "another episode's timing earns less on the cliff"
