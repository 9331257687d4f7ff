"""Which methods are published as a constant threshold."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from safeswitch.handover.panel import Panel
from safeswitch.protocols import Calibrated
from safeswitch.scoring.rows import latched_rows
from safeswitch.scoring.thresholds import plain_thresholds
from safeswitch_baselines.rules.base import ThresholdRule
from synthetic import random_table

PANEL = Panel(random_table(3, 8), "onset")


def rows(method: str = "cem@total", threshold: float = 2.5) -> pd.DataFrame:
    frame = latched_rows(PANEL, Calibrated(ThresholdRule("total", threshold)))
    cell = {"task": "cart-pole", "disturbance": "push", "severity": 3, "protocol": "onset", "learner": 0}
    return frame.assign(**cell, method=method, threshold=threshold)


def test_a_latched_threshold_is_one() -> None:
    assert plain_thresholds(PANEL, rows())["threshold"].tolist() == [2.5]


def test_a_rule_that_hands_over_elsewhere_gives_back_or_ran_on_fewer_episodes_is_none() -> None:
    elsewhere, back = rows(), rows("cem-two@total")
    elsewhere["threshold"] = 0.5
    handed = np.flatnonzero(back["handover"] < PANEL.table.length)[0]
    back.loc[handed, "learner_steps"] += 1  # the learner drives again after the handover
    assert plain_thresholds(PANEL, elsewhere).empty
    assert plain_thresholds(PANEL, back).empty
    assert plain_thresholds(PANEL, rows().head(4)).empty


def test_rows_in_another_order_are_refused() -> None:
    with pytest.raises(ValueError, match="order"):
        plain_thresholds(PANEL, rows().iloc[::-1])
