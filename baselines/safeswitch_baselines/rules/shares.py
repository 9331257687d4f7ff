"""Every signal at the same expert share: thresholds, and a blind control, that spend 5, 10, 20 or 40 % of all steps.

Rules that spend more of the expert's time save more episodes; at one share what differs is the signal alone.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from safeswitch.handover.panel import Calibration
from safeswitch.protocols import Calibrated
from safeswitch_baselines.rules.base import PlainMethod, SignalMethod, ThresholdRule, expert_steps
from safeswitch_baselines.rules.controls import RandomRule, hazard_of

TOLERANCE = 0.01
"""A share is attained if the calibrate episodes have it up to this much."""

UNATTAINABLE = Calibrated(None)
"""Nothing to score: the row stays blank. Shares are of the half-and-half mix, which `onset` does not have."""


class MatchedShare(SignalMethod):
    """Threshold at which the expert drives a given share of all steps of the calibrate mix. Latched."""

    needs = frozenset({"rollouts"})
    share: ClassVar[float]

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """The threshold whose mean expert share is nearest."""
        panel = calibration.panel
        if panel.arming != "start":
            return UNATTAINABLE
        thresholds = panel.candidate_thresholds(self.signal)
        handover = panel.handover_at(self.signal, thresholds)
        apart = np.abs(panel.expert_share(handover).mean(axis=1) - self.share)
        nearest = int(np.argmin(apart))
        threshold = float(thresholds[nearest])
        if apart[nearest] > TOLERANCE or not np.isfinite(threshold):
            return UNATTAINABLE
        queries = expert_steps(panel, handover[nearest])
        return Calibrated(ThresholdRule(self.signal, threshold), threshold, len(panel), queries)


class Share5(MatchedShare):
    """`share-5@signal`: the expert drives 5 % of the steps."""

    family, share = "share-5", 0.05


class Share10(MatchedShare):
    """`share-10@signal`: the expert drives 10 % of the steps."""

    family, share = "share-10", 0.1


class Share20(MatchedShare):
    """`share-20@signal`: the expert drives 20 % of the steps."""

    family, share = "share-20", 0.2


class Share40(MatchedShare):
    """`share-40@signal`: the expert drives 40 % of the steps."""

    family, share = "share-40", 0.4


class RandomShare(PlainMethod):
    """The blind control: a constant hazard with a given expected expert share of the T steps. Latched."""

    share: ClassVar[float]

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Solve for the hazard; an early end of an episode is not known beforehand."""
        panel = calibration.panel
        if panel.arming != "start":
            return UNATTAINABLE
        hazard = hazard_of(self.share, np.array([panel.table.horizon]))
        return Calibrated(RandomRule(hazard), hazard)


class Random5(RandomShare):
    """`random-5`: the expert drives 5 % of the steps, at random."""

    family, share = "random-5", 0.05


class Random10(RandomShare):
    """`random-10`: the expert drives 10 % of the steps, at random."""

    family, share = "random-10", 0.1


class Random20(RandomShare):
    """`random-20`: the expert drives 20 % of the steps, at random."""

    family, share = "random-20", 0.2


class Random40(RandomShare):
    """`random-40`: the expert drives 40 % of the steps, at random."""

    family, share = "random-40", 0.4
