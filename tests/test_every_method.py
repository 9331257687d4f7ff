"""Every method of the registry, under both armings, on arbitrary tables: generated, so a new method is tested too."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from safeswitch import registry, suite
from safeswitch.handover.episode import DEVIATION, NeverSwitch
from safeswitch.handover.panel import Panel
from safeswitch.protocols import ARMINGS, Calibrated, Driver, Method
from synthetic import random_calibration

SIGNALS = ("total", "epistemic", "discrepancy")
METHODS = tuple(name for name in suite.methods(SIGNALS) if name not in suite.OPTIONAL)  # those: test_ppo.py
NEEDS = {"expert-queries", "failures", "rollouts", "privileged"}
SEEDS = (0, 10, 20)


class WithoutShortcut:
    """A rule as an outsider would write it: reset, arm and update only."""

    def __init__(self, rule: Any) -> None:
        self.reset, self.arm, self.update = rule.reset, rule.arm, rule.update


def calibrate(name: str, seed: int, arming: Any) -> tuple[Method, Calibrated, Panel]:
    """The method, calibrated on one arbitrary table, and another one to test it on."""
    method = registry.make_method(name)
    calibrated = method.calibrate(random_calibration(seed, arming, SIGNALS))
    if calibrated.rule is None:
        assert "share-" in name or name.startswith("random-"), "only a share of expert steps may be out of reach"
        calibrated = replace(calibrated, rule=NeverSwitch())
    return method, calibrated, random_calibration(seed + 100, arming, SIGNALS).panel


def test_every_registered_method_is_compared() -> None:
    used = {name.partition("@")[0] for task in suite.TASKS.values() for name in suite.methods(task.signals)}
    used |= {name.partition("@")[0] for name in suite.without_extra()}
    assert set(registry.names("method")) == used


@pytest.mark.parametrize("name", METHODS)
def test_a_method_says_what_it_is(name: str) -> None:
    method = registry.make_method(name)
    assert isinstance(method, Method)
    assert method.id == name and isinstance(method.latched, bool) and method.needs <= NEEDS
    assert method.__class__.__doc__


@pytest.mark.parametrize("arming", ARMINGS)
@pytest.mark.parametrize("name", METHODS)
def test_a_method_calibrates_and_hands_over_at_valid_steps(name: str, arming: Any) -> None:
    for seed in SEEDS:
        method, calibrated, panel = calibrate(name, seed, arming)
        assert isinstance(calibrated.threshold, float) and not np.isinf(calibrated.threshold)
        assert calibrated.tuning_episodes >= 0 and calibrated.expert_queries >= 0
        assert all(isinstance(values, np.ndarray) and values.dtype != object for values in calibrated.log.values())
        if method.latched:
            check_latched(calibrated.rule, panel)
        else:
            check_drivers(calibrated.rule, panel)


def check_latched(rule: Any, panel: Panel) -> None:
    """Handover steps lie in [arming step, length) or are T, the same at every call, and each episode's its own."""
    handover, horizon = panel.handover_of(rule), panel.table.horizon
    assert handover.shape == (len(panel),) and np.issubdtype(handover.dtype, np.integer)
    taken = handover < horizon
    assert (handover[taken] >= panel.arming_step[taken]).all() and (handover[taken] < panel.table.length[taken]).all()
    assert (handover[~taken] == horizon).all()
    np.testing.assert_array_equal(panel.handover_of(rule), handover)
    assert np.isfinite(panel.returns(handover)).all()
    if hasattr(rule, "update"):
        np.testing.assert_array_equal(panel.handover_of(WithoutShortcut(rule)), handover)


def check_drivers(rule: Any, panel: Panel) -> None:
    """A rule that gives control back names a driver at every armed step, the same when it drives the episode again."""

    def drivers(episode: int) -> list[Driver]:
        start = int(panel.arming_step[episode])
        rule.reset(int(panel.table.seeds[episode]))
        chosen = [rule.arm(start)]
        for step in range(start, int(panel.table.length[episode])):
            values = {signal: float(panel.signal(signal)[episode, step]) for signal in SIGNALS}
            values[DEVIATION] = 0.1 * ((episode + step) % 4)  # known to rules that ask the expert, or drive with it
            chosen.append(rule.update(step, values))
        return chosen

    for episode in range(len(panel)):
        first = drivers(episode)
        assert set(first) <= set(Driver) and drivers(episode) == first


@pytest.mark.parametrize("name", METHODS)
def test_a_rule_reads_no_other_signals_than_it_says(name: str) -> None:
    """Plain episodes compute the signals that a rule reads, and no others."""
    method, calibrated, panel = calibrate(name, 0, "start")
    reads = getattr(calibrated.rule, "reads", None)
    if method.latched or reads is None:
        return
    rule = calibrated.rule
    rule.reset(0)
    rule.arm(0)
    for step in range(int(panel.table.length[0])):
        rule.update(step, {name: 1.0 for name in reads} | {DEVIATION: 0.1})


@pytest.mark.parametrize("arming", ARMINGS)
@pytest.mark.parametrize("name", METHODS)
def test_calibration_is_a_function_of_its_arguments(name: str, arming: Any) -> None:
    (_, one, panel), (_, other, _) = calibrate(name, 3, arming), calibrate(name, 3, arming)
    assert one.threshold == other.threshold or np.isnan([one.threshold, other.threshold]).all()
    assert set(one.log) == set(other.log)
    for key, values in one.log.items():
        np.testing.assert_array_equal(values, other.log[key])
    if registry.make_method(name).latched:
        np.testing.assert_array_equal(panel.handover_of(one.rule), panel.handover_of(other.rule))


@pytest.mark.parametrize("arming", ARMINGS)
def test_no_method_beats_the_hindsight_oracle_in_any_episode(arming: Any) -> None:
    for seed in SEEDS:
        _, oracle, panel = calibrate("oracle-hindsight", seed, arming)
        bound = panel.returns(panel.handover_of(oracle.rule))
        for name in METHODS:
            method, calibrated, _ = calibrate(name, seed, arming)
            if method.latched and name != "oracle-onset":  # which may hand over before it is armed: it is told t0
                assert (panel.returns(panel.handover_of(calibrated.rule)) <= bound + 1e-12).all(), name


@pytest.mark.parametrize("arming", ARMINGS)
@pytest.mark.parametrize("signal", SIGNALS)
def test_no_constant_threshold_beats_best(arming: Any, signal: str) -> None:
    thresholds = np.arange(-1.0, 7.0, 0.25)
    for seed in SEEDS:
        _, best, panel = calibrate(f"best@{signal}", seed, arming)
        bound = panel.returns(panel.handover_of(best.rule)).mean()
        assert bound >= panel.returns(panel.handover_at(signal, thresholds)).mean(axis=1).max() - 1e-12
        for rule in ("cem", "grid", "random-search", *suite.QUANTILES):
            _, calibrated, _ = calibrate(f"{rule}@{signal}", seed, arming)
            assert panel.returns(panel.handover_of(calibrated.rule)).mean() <= bound + 1e-12
