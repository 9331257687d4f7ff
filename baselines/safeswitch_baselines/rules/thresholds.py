"""Thresholds set by hand: quantiles of the undisturbed signal, and absolute values, the same for every task."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from safeswitch.handover.panel import Calibration
from safeswitch.protocols import Calibrated
from safeswitch_baselines.rules.base import SignalMethod, ThresholdRule


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
    """An absolute value in the signal's units, set by hand without any data."""

    value: ClassVar[float]

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Nothing to choose."""
        return Calibrated(ThresholdRule(self.signal, self.value), self.value)


class Fixed005(FixedValue):
    """`fixed-0.05@`: 5 % of the largest action."""

    family, value = "fixed-0.05", 0.05


class Fixed01(FixedValue):
    """`fixed-0.1@`: 10 % of the largest action."""

    family, value = "fixed-0.1", 0.1


class Fixed02(FixedValue):
    """`fixed-0.2@`: 20 % of the largest action."""

    family, value = "fixed-0.2", 0.2


class Fixed04(FixedValue):
    """`fixed-0.4@`: 40 % of the largest action."""

    family, value = "fixed-0.4", 0.4
