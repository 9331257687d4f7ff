"""cem-vector: one score in the search and in an episode, at CEM's budget, and better where one signal is not enough."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safeswitch import registry
from safeswitch.handover.panel import Calibration, Panel
from safeswitch.handover.table import HandoverTable
from safeswitch.protocols import ARMINGS, Driver
from safeswitch_baselines.rules.cem import CEM
from safeswitch_baselines.rules.cem_vector import (
    Baseline,
    CEMVector,
    CEMVectorReturn,
    Parameters,
    Score,
    Settings,
    VectorRule,
    alarms,
    learn,
    vector_signals,
)
from synthetic import calibration, cliff_table

EDGE = 0.12


def hidden_cliff(seed: int, disturbed: bool) -> HandoverTable:
    """A cliff after a swing-up, in which the signal of every episode is higher, beside a signal that says nothing."""
    table = cliff_table(EDGE, 40, disturbed, seed)
    rng = np.random.default_rng(seed + 1)
    swing = np.where(np.arange(80) < 8, 55.0, 1.0)  # over before the first onset
    noise = np.exp(0.5 * rng.standard_normal((40, 80)))
    return table.with_signal("total", table.signals["total"] * swing).with_signal("epistemic", noise)


def hidden(arming: Any, seed: int = 0) -> Calibration:
    return calibration(hidden_cliff(seed, True), hidden_cliff(seed + 50, False), arming, seed)


@pytest.mark.parametrize("arming", ARMINGS)
def test_the_search_scores_what_an_episode_does(arming: Any) -> None:
    """For arbitrary points of the search space the handover steps of the search are those of the rule itself."""
    chosen = hidden(arming)
    baseline, panel = Baseline.fit(chosen.nominal), chosen.panel.take(np.arange(20, 60) % len(chosen.panel))
    points = np.random.default_rng(0).normal([0.0, 0.0, 0.5, -0.5, 0.0, 2.0], 1.0, (12, 6))
    found = alarms(panel, baseline.standardised(panel), points)
    assert len(np.unique(found)) > 20
    for point, expected in zip(points, found, strict=True):
        rule = VectorRule(Score(baseline, Parameters.of(point), panel.table.horizon))
        np.testing.assert_array_equal(panel.handover_of(rule), expected)


@pytest.mark.parametrize("arming", ARMINGS)
def test_it_spends_no_more_than_cem(arming: Any) -> None:
    chosen = hidden(arming)
    assert CEMVector().calibrate(chosen).tuning_episodes <= CEM("total").calibrate(chosen).tuning_episodes


def test_it_finds_what_is_hidden_below_the_swing_up_that_all_episodes_share() -> None:
    test = hidden("start", seed=7).panel
    earned = {
        name: test.returns(test.handover_of(registry.make_method(name).calibrate(hidden("start")).rule)).mean()
        for name in ("cem-vector", "cem@total", "best@total", "oracle-hindsight")
    }
    assert earned["cem@total"] <= earned["best@total"] < earned["cem-vector"] - 0.2
    gap = earned["oracle-hindsight"] - earned["cem@total"]
    assert earned["cem-vector"] - earned["cem@total"] > 0.5 * gap


def test_weights_go_to_the_signal_that_tells() -> None:
    score, _ = learn(hidden("start"), Settings(), "cem-vector")
    weights = dict(zip(score.baseline.names, score.parameters.weights, strict=True))
    assert weights["total"] > weights["epistemic"] and sum(weights.values()) == pytest.approx(1)
    assert score.parameters.blend > 0.5


def test_units_of_a_signal_do_not_matter() -> None:
    """A signal in other units is the same logarithm but for a constant: same search, same handovers."""
    chosen, test = hidden("onset"), hidden("onset", seed=3).panel

    def in_units(table: HandoverTable) -> HandoverTable:
        return table.with_signal("total", 1000 * table.signals["total"])

    moved = Calibration(Panel(in_units(chosen.panel.table), "onset"), in_units(chosen.nominal), seed=chosen.seed)
    plain = test.handover_of(CEMVector().calibrate(chosen).rule)
    other = Panel(in_units(test.table), "onset").handover_of(CEMVector().calibrate(moved).rule)
    np.testing.assert_array_equal(plain, other)


def test_smoothed_signals_and_those_it_does_not_listen_to_are_left_out() -> None:
    recorded = dict.fromkeys(["total-mean3", "total", "aleatoric", "rnd", "dynamics-residual", "discrepancy"])
    assert vector_signals(recorded) == ("dynamics-residual", "rnd", "total")


def test_the_rule_that_gives_back_hands_over_where_the_latched_one_does() -> None:
    chosen, panel = hidden("start"), hidden("start", seed=5).panel
    latched = panel.handover_of(CEMVector().calibrate(chosen).rule)
    rule = CEMVectorReturn().calibrate(chosen).rule
    for episode in range(0, len(panel), 7):
        rule.reset(0)
        rule.arm(0)
        values = ({name: float(t[episode, step]) for name, t in panel.table.signals.items()} for step in range(79))
        drivers = [rule.update(step, each) for step, each in enumerate(values)]
        first = drivers.index(Driver.EXPERT) + 1 if Driver.EXPERT in drivers else panel.table.horizon
        assert first == latched[episode]
