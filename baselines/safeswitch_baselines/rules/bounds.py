"""Bounds between which every rule must lie: learner, expert, timer and the two oracles."""

from __future__ import annotations

import numpy as np

from safeswitch.handover.episode import NeverSwitch
from safeswitch.handover.panel import PHI, Calibration, Panel
from safeswitch.handover.table import Ints
from safeswitch.protocols import Calibrated
from safeswitch_baselines.rules.base import DelayRule, PlainMethod, SignalMethod, ThresholdRule, expert_steps


class LearnerOnly(PlainMethod):
    """`learner`: never hands over."""

    family = "learner"

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Nothing to choose."""
        return Calibrated(NeverSwitch())


class ExpertOnly(PlainMethod):
    """`expert`: hands over at the arming step."""

    family = "expert"

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Nothing to choose."""
        return Calibrated(DelayRule(0))


class Timer(PlainMethod):
    """`timer`: the best single delay after the arming step on the calibrate episodes, whatever the signals say.

    Delays are tried on every calibrate episode, coarse ones first (`Panel.best_delay`).
    """

    family = "timer"
    needs = frozenset({"failures", "rollouts"})

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Best mean return over all delays."""
        panel = calibration.panel
        delay, tried = panel.best_delay(calibration.phi)
        queries = expert_steps(panel, panel.delayed(tried))
        return Calibrated(DelayRule(delay), float(delay), len(tried) * len(panel), queries)


class _AtOnset:
    """Table rule: hands over at t0; undisturbed episodes are left to the learner."""

    def handover_steps(self, panel: Panel) -> Ints:
        return np.where(panel.table.disturbed, panel.table.onset, panel.table.horizon)


class OracleOnset(PlainMethod):
    """`oracle-onset`: hands over exactly at t0. Privileged: it is told t0."""

    family = "oracle-onset"
    needs = frozenset({"privileged"})

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Nothing to choose."""
        return Calibrated(_AtOnset())


class _Hindsight:
    """Table rule: per episode, the handover step (or none) with the highest return."""

    def __init__(self, phi: float):
        self.phi = phi

    def handover_steps(self, panel: Panel) -> Ints:
        return np.array([self._best(panel, episode) for episode in range(len(panel))])

    def _best(self, panel: Panel, episode: int) -> int:
        """The latest handover that succeeds, or never where that earns more; a later one always earns more."""
        table, never = panel.table, panel.table.horizon
        if table.learner_success[episode]:
            return never
        start, length = int(panel.arming_step[episode]), int(table.length[episode])
        for step in range(length - 1, start - 1, -1):
            if table.outcome(np.array([episode]), np.array([step]))[0]:
                alone = (length - start) / never
                return step if (step - start) / never + self.phi >= alone else never
        return never


class OracleHindsight(PlainMethod):
    """`oracle-hindsight`: best return over all handover steps and never, episode by episode. Privileged."""

    family = "oracle-hindsight"
    needs = frozenset({"privileged"})

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Nothing to choose: it looks at the outcomes."""
        return Calibrated(_Hindsight(calibration.phi))


class _BestThreshold:
    """Table rule: the constant threshold that is best on the very episodes it is scored on."""

    def __init__(self, signal: str, phi: float = PHI):
        self.signal, self.phi = signal, phi

    def handover_steps(self, panel: Panel) -> Ints:
        threshold, _ = panel.best_threshold(self.signal, self.phi)
        return ThresholdRule(self.signal, threshold).handover_steps(panel)


class BestThreshold(SignalMethod):
    """`best@signal`: hindsight optimum of a constant threshold on the test episodes, per learner. Privileged."""

    family = "best"
    needs = frozenset({"privileged"})

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """The threshold is chosen when it is scored."""
        return Calibrated(_BestThreshold(self.signal, calibration.phi))
