"""Matched expert share, and the Simplex: each does exactly what its name says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safeswitch import registry, suite
from safeswitch.handover.panel import Panel
from safeswitch.handover.table import new_table
from safeswitch.protocols import ARMINGS
from safeswitch_baselines.rules.shares import TOLERANCE
from synthetic import calibration, cliff_table, random_calibration


def spread(count: int = 200, seed: int = 0, T: int = 80) -> Any:
    """Calibration on episodes whose signal rises somewhere, disturbed or not."""
    rng = np.random.default_rng(seed)
    tables = []
    for disturbed in (True, False):
        trace = np.cumsum(rng.random((count, T)) * rng.random((count, 1)), axis=1)
        onset = rng.integers(8, 40, count) if disturbed else np.full(count, -1)
        known = np.ones((count, T + 1), np.int8)
        length, success = np.full(count, T), np.ones(count, bool)
        tables.append(new_table(np.arange(count), onset, length, success, {"total": trace}, known))
    return calibration(*tables, "start")


@pytest.mark.parametrize("share", suite.SHARES)
def test_the_expert_drives_that_share_of_all_steps(share: int) -> None:
    chosen, fresh = spread(), spread(seed=1).panel
    found = registry.make_method(f"share-{share}@total").calibrate(chosen)
    spent = chosen.panel.expert_share(chosen.panel.handover_of(found.rule)).mean()
    assert spent == pytest.approx(share / 100, abs=TOLERANCE)
    assert fresh.expert_share(fresh.handover_of(found.rule)).mean() == pytest.approx(share / 100, abs=0.05)
    blind = registry.make_method(f"random-{share}").calibrate(chosen)
    assert fresh.expert_share(fresh.handover_of(blind.rule)).mean() == pytest.approx(share / 100, abs=0.07)


def test_a_share_out_of_reach_is_blank() -> None:
    """A signal that jumps once, for all episodes at the same step, has two shares only; `onset` has no mix at all."""
    chosen = spread(20)
    step = np.where(np.arange(80) >= 71, 1.0, 0.0)[None, :] * np.ones((40, 1))
    panel = chosen.panel.with_signal("total", step)
    flat = calibration(panel.table.take(np.arange(20)), panel.table.take(np.arange(20, 40)), "start")
    found = {share: registry.make_method(f"share-{share}@total").calibrate(flat).rule for share in suite.SHARES}
    assert found[10] is not None and found[5] is None  # 8 of 80 steps: the alarm at step 71 hands over from 72 on
    assert found[20] is None and found[40] is None
    onset = random_calibration(0, "onset")
    assert registry.make_method("share-10@total").calibrate(onset).rule is None
    assert registry.make_method("random-10").calibrate(onset).rule is None


@pytest.mark.parametrize("arming", ARMINGS)
def test_simplex_hands_over_at_the_last_recoverable_step_of_the_cliff(arming: Any) -> None:
    panel: Panel = calibration(cliff_table(0.12), cliff_table(0.12, disturbed=False), arming).panel
    handover = panel.handover_of(registry.make_method("simplex").calibrate(None).rule)  # type: ignore[arg-type]
    table, disturbed = panel.table, panel.table.disturbed
    assert (handover[~disturbed] == table.horizon).all(), "always recoverable: never"
    assert panel.success(handover).all()
    rows = np.flatnonzero(disturbed)
    assert not table.outcome(rows, handover[rows] + 1).any(), "one step later is too late"
    np.testing.assert_array_equal(handover[rows], table.t_first[rows])


@pytest.mark.parametrize("arming", ARMINGS)
def test_simplex_stops_at_the_first_step_that_is_not_recoverable(arming: Any) -> None:
    for seed in range(20):
        panel = random_calibration(seed, arming).panel
        handover = panel.handover_of(registry.make_method("simplex").calibrate(None).rule)  # type: ignore[arg-type]
        for episode, step in enumerate(handover):
            start = max(panel.arming_step[episode], panel.table.onset[episode])
            checked = np.arange(start, panel.table.length[episode])
            good = panel.table.outcome(np.full(len(checked), episode), checked)
            if good.all():
                assert step == panel.table.horizon
            else:
                assert step == max(checked[np.argmin(good)] - 1, start)
