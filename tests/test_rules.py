"""Rules set by hand and the bounds: thresholds by definition."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safeswitch import registry
from safeswitch.handover.panel import DELAY_STEP, Panel
from safeswitch.protocols import ARMINGS
from synthetic import HORIZON, calibration, cliff_table, random_calibration

EDGE = 0.12


def calibrated(name: str, chosen: Any) -> Any:
    return registry.make_method(name).calibrate(chosen)


@pytest.mark.parametrize("arming", ARMINGS)
@pytest.mark.parametrize(("rule", "level"), [("fixed-q95", 0.95), ("fixed-q99", 0.99), ("fixed-q999", 0.999)])
def test_step_quantiles_are_those_of_all_undisturbed_steps(rule: str, level: float, arming: Any) -> None:
    for seed in range(5):
        chosen = random_calibration(seed, arming)
        traces = chosen.nominal.signals["total"]
        steps = np.concatenate([trace[:length] for trace, length in zip(traces, chosen.nominal.length, strict=True)])
        found = calibrated(f"{rule}@total", chosen)
        assert found.threshold == pytest.approx(np.quantile(steps, level), abs=1e-12) == found.rule.threshold
        assert found.tuning_episodes == len(chosen.nominal)


@pytest.mark.parametrize("arming", ARMINGS)
def test_episode_quantile_is_that_of_the_maxima(arming: Any) -> None:
    for seed in range(5):
        chosen = random_calibration(seed, arming)
        maxima = [trace[~np.isnan(trace)].max() for trace in chosen.nominal.signals["total"]]
        assert calibrated("fixed-epmax95@total", chosen).threshold == pytest.approx(np.quantile(maxima, 0.95))


@pytest.mark.parametrize("value", [0.05, 0.1, 0.2, 0.4])
def test_values_set_by_hand_are_taken_as_they_are(value: float) -> None:
    found = calibrated(f"fixed-{value:g}@total", random_calibration(0, "start"))
    assert (found.threshold, found.tuning_episodes) == (value, 0)


@pytest.mark.parametrize("arming", ARMINGS)
def test_bounds_hand_over_where_they_say(arming: Any) -> None:
    chosen = random_calibration(4, arming)
    panel = chosen.panel
    step = {name: panel.handover_of(calibrated(name, chosen).rule) for name in ("learner", "expert", "oracle-onset")}
    assert (step["learner"] == HORIZON).all()
    np.testing.assert_array_equal(step["expert"], panel.arming_step)
    expected = np.where(panel.table.disturbed, panel.table.onset, HORIZON)
    np.testing.assert_array_equal(step["oracle-onset"], expected)


@pytest.mark.parametrize("arming", ARMINGS)
def test_timer_is_the_best_delay_on_calibrate(arming: Any) -> None:
    for seed in range(5):
        chosen = random_calibration(seed, arming)
        panel = chosen.panel
        found = calibrated("timer", chosen)
        coarse = [*range(0, HORIZON, DELAY_STEP), HORIZON]
        earned = [
            panel.returns(panel.executed(np.minimum(panel.arming_step + k, HORIZON))).mean() for k in range(HORIZON + 1)
        ]
        best = max(coarse, key=lambda delay: earned[delay])
        around = range(max(best - DELAY_STEP + 1, 0), min(best + DELAY_STEP, HORIZON + 1))
        assert panel.returns(panel.handover_of(found.rule)).mean() == pytest.approx(max(earned[k] for k in around))
        assert found.threshold in around
        assert found.tuning_episodes == len({*coarse, *around}) * len(panel)


@pytest.mark.parametrize("arming", ARMINGS)
def test_best_finds_the_edge_of_the_cliff(arming: Any) -> None:
    test = calibration(cliff_table(EDGE), cliff_table(EDGE, disturbed=False), arming).panel
    rule = calibrated("best@total", calibration(cliff_table(EDGE), cliff_table(EDGE, disturbed=False), arming)).rule
    handover = test.handover_of(rule)
    assert test.success(handover).all()
    just_below = test.handover_at("total", np.array([EDGE * (1 - 1e-9)]))[0]
    np.testing.assert_array_equal(handover, just_below)
    assert not test.success(test.handover_at("total", np.array([EDGE]))[0])[test.table.disturbed].any()


@pytest.mark.parametrize("arming", ARMINGS)
def test_the_price_of_failure_decides_between_learner_and_expert(arming: Any) -> None:
    """With phi below what the learner's steps earn, `best` leaves the learner in control of the cliff."""
    panel: Panel = calibration(cliff_table(EDGE), cliff_table(EDGE, disturbed=False), arming).panel
    dear, _ = panel.best_threshold("total", phi=5.0)
    cheap, _ = panel.best_threshold("total", phi=0.01)
    assert dear < EDGE <= cheap
