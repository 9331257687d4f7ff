"""CEM and the searches at its budget: the threshold is found, from far away too, and everything is recorded."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from safeswitch import registry
from safeswitch.handover.panel import PHI, Calibration
from safeswitch.handover.table import HandoverTable
from safeswitch.protocols import ARMINGS
from safeswitch_baselines.rules.cem import CEM, CEMLiteral, learn_threshold
from synthetic import calibration, cliff_table, random_calibration

EDGE = 0.12
FACTOR = 2.0
"""CEM may stay below the edge by this factor: its spread has a floor, and thresholds above the edge earn nothing."""

LOG = {"samples", "sample_success", "sample_return", "mu", "sigma", "reward_sum", "accepted"}


def cliff(arming: Any, seed: int = 0) -> Calibration:
    return calibration(cliff_table(EDGE, seed=seed), cliff_table(EDGE, disturbed=False, seed=seed), arming, seed)


def hopeless(arming: Any) -> Calibration:
    """Whatever is done, every episode fails."""

    def failing(table: HandoverTable) -> HandoverTable:
        table.sources[0].known[:] = 0
        return replace(table, learner_success=np.zeros(len(table), bool))

    disturbed, nominal = cliff_table(EDGE), cliff_table(EDGE, disturbed=False)
    return calibration(failing(disturbed), failing(nominal), arming)


@pytest.mark.parametrize("arming", ARMINGS)
@pytest.mark.parametrize("rule", ["cem", "cem-high", "cem-low"])
def test_cem_finds_the_edge_even_from_initial_values_ten_times_off(rule: str, arming: Any) -> None:
    for seed in range(3):
        found = registry.make_method(f"{rule}@total").calibrate(cliff(arming, seed))
        assert EDGE / FACTOR < found.threshold < EDGE
        assert found.threshold == found.rule.threshold


def test_initial_values_ten_times_off_are_ten_times_off() -> None:
    for arming in ARMINGS:
        base = registry.make_method("cem@total").settings(arming)  # type: ignore[attr-defined]
        assert registry.make_method("cem-high@total").settings(arming) == replace(base, mu=10 * base.mu)  # type: ignore[attr-defined]
        assert registry.make_method("cem-low@total").settings(arming) == replace(base, mu=base.mu / 10)  # type: ignore[attr-defined]


@pytest.mark.parametrize("arming", ARMINGS)
@pytest.mark.parametrize("method", [CEM("total"), CEMLiteral("total")], ids=lambda method: method.family)
def test_everything_is_recorded(method: CEM, arming: Any) -> None:
    settings, found = method.settings(arming), method.calibrate(cliff(arming))
    log = found.log
    rows = len(log["mu"])
    assert set(log) >= LOG
    for name in ("samples", "sample_success", "sample_return"):
        assert log[name].shape == (rows, settings.candidates)
    for name in ("mu", "sigma", "reward_sum", "accepted"):
        assert log[name].shape == (rows,)
    assert log["accepted"].dtype == bool and log["accepted"].sum() >= min(settings.iterations, rows)
    np.testing.assert_allclose(log["reward_sum"], log["sample_return"].sum(axis=1))
    assert found.tuning_episodes == rows * settings.candidates * settings.episodes
    m = settings.episodes
    np.testing.assert_allclose(log["sample_success"] * m, np.round(log["sample_success"] * m), atol=1e-9)
    assert ((log["sample_return"] >= 0) & (log["sample_return"] <= PHI + 1)).all()


@pytest.mark.parametrize("arming", ARMINGS)
def test_candidates_of_an_iteration_share_their_episodes(arming: Any) -> None:
    """Where handing over changes no outcome, all candidates of an iteration succeed equally often."""
    chosen = cliff(arming)
    lucky = np.random.default_rng(0).random(len(chosen.panel)) < 0.6
    table = replace(chosen.panel.table, learner_success=lucky)
    for source, row, success in zip(table.source, table.row, lucky, strict=True):
        table.sources[source].known[row] = success
    log = CEM("total").calibrate(replace(chosen, panel=type(chosen.panel)(table, arming))).log
    shares = log["sample_success"]
    np.testing.assert_array_equal(shares, np.broadcast_to(shares[:, :1], shares.shape))
    assert len(np.unique(shares[:, 0])) > 1, "and iterations have different episodes"


@pytest.mark.parametrize("arming", ARMINGS)
def test_an_iteration_without_successes_is_repeated_but_not_for_ever(arming: Any) -> None:
    settings = CEM("total").settings(arming)
    found = CEM("total").calibrate(hopeless(arming))
    log = found.log
    assert len(log["mu"]) == settings.iterations + settings.repeats
    assert not log["accepted"].any()
    np.testing.assert_allclose(log["mu"][: settings.repeats], np.log(settings.mu))
    np.testing.assert_array_equal(log["sigma"][: settings.repeats], settings.sigma)
    assert np.isfinite(found.threshold) and found.threshold > 0


def test_the_spread_never_falls_below_its_floor() -> None:
    for arming in ARMINGS:
        settings = CEM("total").settings(arming)
        assert CEM("total").calibrate(cliff(arming)).log["sigma"].min() >= settings.floor


def test_thresholds_are_drawn_in_log_space_and_literally_as_they_are() -> None:
    ours, literal = CEM("total").calibrate(cliff("onset")), CEMLiteral("total").calibrate(cliff("onset"))
    assert (ours.log["samples"] > 0).all()
    average = CEM("total").settings("onset").average
    assert ours.threshold == pytest.approx(np.exp(ours.log["mu"][-average:].mean()))
    assert (literal.log["samples"] < 0).any(), "a normal distribution does not stop at zero"
    assert literal.threshold == literal.log["mu"][-1]
    assert literal.log["samples"][0].mean() == pytest.approx(CEMLiteral("total").settings("onset").mu, rel=1.0)


@pytest.mark.parametrize("arming", ARMINGS)
def test_seeds_differ_and_repeat(arming: Any) -> None:
    chosen, settings = cliff(arming), CEM("total").settings(arming)
    one, again, other = (learn_threshold(chosen.panel, "total", settings, seed, PHI) for seed in (1, 1, 2))
    assert one.threshold == again.threshold != other.threshold


@pytest.mark.parametrize("arming", ARMINGS)
@pytest.mark.parametrize("rule", ["grid", "random-search"])
def test_searches_spend_exactly_what_cem_spends(rule: str, arming: Any) -> None:
    for chosen in (cliff(arming), random_calibration(3, arming), hopeless(arming)):
        budget = CEM("total").calibrate(chosen).tuning_episodes
        found = registry.make_method(f"{rule}@total").calibrate(chosen)
        assert found.tuning_episodes == budget
        assert found.threshold in found.log["samples"]
        chosen_one = np.flatnonzero(found.log["samples"] == found.threshold)[0]
        assert found.log["sample_return"][chosen_one] == found.log["sample_return"].max()


@pytest.mark.parametrize("arming", ARMINGS)
@pytest.mark.parametrize("rule", ["grid", "random-search"])
def test_searches_find_the_best_of_their_candidates_on_the_cliff(rule: str, arming: Any) -> None:
    found = registry.make_method(f"{rule}@total").calibrate(cliff(arming))
    samples, panel = found.log["samples"], cliff(arming).panel
    handover = panel.handover_at("total", np.array([found.threshold, samples[samples < EDGE].max()]))
    np.testing.assert_array_equal(*handover)  # the return grows with the threshold up to the edge
