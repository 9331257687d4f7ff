"""Thresholds set by hand: quantiles of the undisturbed signal, and absolute values declared once for all tasks."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import numpy as np

from safeswitch.handover.panel import Calibration
from safeswitch.protocols import Calibrated
from safeswitch_baselines.rules.base import SignalMethod, ThresholdRule

ABSOLUTE_VALUES = (0.05, 0.1, 0.2, 0.4)
"""Hand-set thresholds in action units, the same for every task: 5 % to 40 % of the largest action."""


class FixedStepQuantile(SignalMethod):
    """Quantile of the signal over all steps of undisturbed calibrate episodes. Needs no failure and no rollout."""

    level: ClassVar[float]

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Quantile over steps."""
        table = calibration.nominal
        threshold = float(np.nanquantile(table.signals[self.signal], self.level))
        return Calibrated(ThresholdRule(self.signal, threshold), threshold, tuning_episodes=len(table))


class FixedQ95(FixedStepQuantile):
    """`fixed-q95@`: 95 % quantile of steps."""

    family, level = "fixed-q95", 0.95


class FixedQ99(FixedStepQuantile):
    """`fixed-q99@`: 99 % quantile of steps."""

    family, level = "fixed-q99", 0.99


class FixedQ999(FixedStepQuantile):
    """`fixed-q999@`: 99.9 % quantile of steps."""

    family, level = "fixed-q999", 0.999


class FixedEpisodeMax95(SignalMethod):
    """`fixed-epmax95@`: 95 % quantile of the maxima of undisturbed calibrate episodes."""

    family = "fixed-epmax95"

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Quantile over episodes."""
        table = calibration.nominal
        threshold = float(np.quantile(np.nanmax(table.signals[self.signal], axis=1), 0.95))
        return Calibrated(ThresholdRule(self.signal, threshold), threshold, tuning_episodes=len(table))


class FixedValue(SignalMethod):
    """`fixed-0.1@` and so on: an absolute value in the signal's units, set by hand without any data."""

    def __init__(self, signal: str | None, value: float):
        self.family = f"fixed-{value:g}"  # type: ignore[misc]
        super().__init__(signal)
        self.value = value

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Nothing to choose."""
        return Calibrated(ThresholdRule(self.signal, self.value), self.value)


def _fixed(value: float) -> Callable[[str | None], FixedValue]:
    return lambda signal=None: FixedValue(signal, value)


fixed_005, fixed_01, fixed_02, fixed_04 = (_fixed(value) for value in ABSOLUTE_VALUES)
