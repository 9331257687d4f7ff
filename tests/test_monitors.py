"""Monitors: what conformal prediction promises, and what patience waits for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import betabinom, kstest

from safeswitch import registry
from safeswitch.handover.panel import Calibration, Panel
from safeswitch.handover.table import HandoverTable, new_table
from safeswitch.protocols import Driver
from safeswitch_baselines.rules.monitors import (
    ALPHA,
    PATIENCE,
    ConformalBand,
    PatienceRule,
    conformal_quantile,
    step_profile,
)

T = 20


def undisturbed(count: int, seed: int) -> HandoverTable:
    """Exchangeable episodes with a course of their own, noise that grows, and whole episodes that run higher."""
    rng = np.random.default_rng(seed)
    level = rng.gamma(2.0, 1.0, (count, 1))
    course = 3 * np.sin(np.linspace(0, 6, T)) + level + np.linspace(0.1, 1, T) * rng.standard_normal((count, T))
    known = np.ones((count, T + 1), np.int8)
    return new_table(
        np.arange(count), np.full(count, -1), np.full(count, T), np.ones(count, bool), {"total": course}, known
    )


def false_alarms(method: str, calibrate: int, test: int, seed: int) -> int:
    """Alarms on `test` undisturbed episodes after calibrating on `calibrate` ones of the same kind."""
    table = undisturbed(calibrate + test, seed)
    nominal = table.take(np.arange(calibrate))
    rule = registry.make_method(method).calibrate(Calibration(Panel(nominal, "start"), nominal, seed=seed)).rule
    handover = Panel(table.take(np.arange(calibrate, calibrate + test)), "start").handover_of(rule)
    # an alarm at the very last step hands over from T on: nothing is left to hand over, so count the episode's steps
    return int(np.sum(handover < T)) + last_step_alarms(rule, table, calibrate, handover)


def last_step_alarms(rule: Any, table: HandoverTable, first: int, handover: Any) -> int:
    """Episodes whose first alarm comes at step T - 1."""
    count = 0
    for index in np.flatnonzero(handover == T):
        rule.reset(0)
        drivers = [rule.update(t, {"total": float(table.signals["total"][first + index, t])}) for t in range(T)]
        count += drivers[-1] is Driver.EXPERT
    return count


@pytest.mark.parametrize(("method", "scored"), [("conformal@total", 40), ("conformal-band@total", 20)])
def test_false_alarms_follow_the_beta_binomial(method: str, scored: int) -> None:
    """The number of alarms among m exchangeable episodes is beta-binomial(m, n + 1 - k, k), n scored episodes."""
    m, trials = 30, 300
    k = int(np.ceil((scored + 1) * (1 - ALPHA)))
    counts = np.array([false_alarms(method, 40, m, seed) for seed in range(trials)])
    law = betabinom(m, scored + 1 - k, k)
    assert counts.mean() / m <= ALPHA + 0.01
    assert counts.mean() == pytest.approx(law.mean(), abs=4 * law.std() / np.sqrt(trials))
    jitter = np.random.default_rng(0).uniform(size=trials)  # randomised, the transform of a discrete law is uniform
    uniform = law.cdf(counts - 1) + jitter * law.pmf(counts)
    assert kstest(uniform, "uniform").pvalue > 0.001


def test_the_conformal_quantile_is_an_order_statistic_or_promises_nothing() -> None:
    scores = np.random.default_rng(3).permutation(np.arange(1.0, 20.0))
    assert conformal_quantile(scores, 0.05) == 19  # k = ceil(20 * 0.95) = 19 of 19
    assert conformal_quantile(scores, 0.5) == 10
    assert conformal_quantile(scores[:18], 0.05) == np.inf


def test_with_too_few_episodes_a_conformal_rule_never_alarms() -> None:
    for method in ("conformal@total", "conformal-band@total"):
        nominal = undisturbed(12, 0)
        found = registry.make_method(method).calibrate(Calibration(Panel(nominal, "start"), nominal))
        assert np.isnan(found.threshold)
        assert (Panel(undisturbed(50, 1), "start").handover_of(found.rule) == T).all()


def test_the_band_does_not_depend_on_a_course_that_all_episodes_share() -> None:
    nominal, test = undisturbed(40, 2), undisturbed(40, 5)
    course = 50 * np.cos(np.arange(T))
    moved = [each.with_signal("total", each.signals["total"] + course) for each in (nominal, test)]
    plain = ConformalBand("total").calibrate(Calibration(Panel(nominal, "start"), nominal)).rule
    other = ConformalBand("total").calibrate(Calibration(Panel(moved[0], "start"), moved[0])).rule
    np.testing.assert_array_equal(Panel(test, "start").handover_of(plain), Panel(moved[1], "start").handover_of(other))


def test_the_profile_is_that_of_the_traces_that_reach_a_step() -> None:
    trace = np.array([[1.0, 2.0, np.nan, np.nan], [3.0, 6.0, 5.0, np.nan]])
    mean, width = step_profile(trace)
    np.testing.assert_allclose(mean, [2, 4, 5, 5])
    np.testing.assert_allclose(width[:2], [1, 2])
    assert (width[2:] > 0).all(), "one trace alone has no spread, and a band needs a width"


def test_patience_waits_for_consecutive_steps_from_the_arming_step_on() -> None:
    def alarm(values: list[float], armed: int = 0) -> int | None:
        rule = PatienceRule("total", 1.0, PATIENCE)
        rule.reset(0)
        rule.arm(armed)
        drivers = [rule.update(armed + i, {"total": value}) for i, value in enumerate(values)]
        return drivers.index(Driver.EXPERT) if Driver.EXPERT in drivers else None

    high, low = 2.0, 1.0  # the threshold itself is not above it
    assert alarm([high] * PATIENCE) == PATIENCE - 1
    assert alarm([*[high] * (PATIENCE - 1), low] * 5) is None, "interrupted runs never add up"
    assert alarm([low, high, low, *[high] * PATIENCE, low, low]) == PATIENCE + 2
    assert alarm([high] * (PATIENCE - 1), armed=7) is None


def test_patience_of_one_step_is_the_threshold_rule() -> None:
    table = undisturbed(60, 9)
    panel, threshold = Panel(table, "start"), float(np.quantile(table.signals["total"], 0.98))
    one = panel.handover_of(PatienceRule("total", threshold, 1))
    np.testing.assert_array_equal(one, panel.handover_at("total", np.array([threshold]))[0])
    three = panel.handover_of(PatienceRule("total", threshold, PATIENCE))
    assert (three >= one).all() and (three > one).any()
