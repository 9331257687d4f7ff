"""Two thresholds with a dwell time: hand over above the one, give back after a while below the other.

The upper threshold is the one that is learned for handing over once and for all, from the exact table. The lower one
cannot be learned there, as what happens after giving back depends on more than the handover step; it is the median of
undisturbed steps. The dwell keeps the rule from chattering while the signal crosses the lower threshold.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from safeswitch.handover.panel import Calibration
from safeswitch.protocols import Calibrated, Driver
from safeswitch_baselines.rules.base import SignalMethod
from safeswitch_baselines.rules.cem import CEM

DWELL = 10
"""Consecutive steps below the lower threshold after which control is given back."""
LEVEL = 0.5
"""Quantile of undisturbed steps that is the lower threshold."""


class Dwell:
    """Gives control back: expert once the value was above `upper`, learner after `DWELL` steps at or below `lower`."""

    def __init__(self, upper: float, lower: float):
        self.upper, self.lower = float(upper), min(float(lower), float(upper))
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Give the learner control."""
        self._driver, self._below = Driver.LEARNER, 0

    def arm(self, step: int) -> Driver:
        """Nothing was measured yet while armed: the learner drives."""
        return self._driver

    def update(self, step: int, signals: Mapping[str, float]) -> Driver:
        """Alarm, or count towards giving back."""
        value = self.value(step, signals)
        self._below = self._below + 1 if value <= self.lower else 0
        if value > self.upper:
            self._driver = Driver.EXPERT
        elif self._below >= DWELL:
            self._driver = Driver.LEARNER
        return self._driver

    def value(self, step: int, signals: Mapping[str, float]) -> float:
        """What is compared with the thresholds."""
        raise NotImplementedError


class DwellOnSignal(Dwell):
    """Two thresholds on one signal."""

    def __init__(self, signal: str, upper: float, lower: float):
        super().__init__(upper, lower)
        self.signal = signal
        self.reads = (signal,)

    def value(self, step: int, signals: Mapping[str, float]) -> float:
        """The signal."""
        return signals[self.signal]


class CEMTwo(SignalMethod):
    """`cem-two@signal`: CEM's threshold to hand over, the median of undisturbed steps and a dwell to give back.

    Calibration: upper threshold as `cem@signal`; lower threshold the 50 % quantile of the signal over undisturbed
    calibrate steps, or the upper one if that is lower. Decision: expert once signal > upper. Return: learner after 10
    consecutive steps with signal <= lower.
    """

    family = "cem-two"
    latched = False
    needs = frozenset({"failures", "rollouts"})

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Algorithm 1 for the upper threshold, a quantile for the lower one."""
        learned = CEM(self.signal).calibrate(calibration)
        lower = float(np.nanquantile(calibration.nominal.signals[self.signal], LEVEL))
        rule = DwellOnSignal(self.signal, learned.threshold, lower)
        return Calibrated(rule, learned.threshold, learned.tuning_episodes, learned.expert_queries)
