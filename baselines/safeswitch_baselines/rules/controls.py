"""Controls: what a rule earns that spends as much expert time as `cem@total`, but without its information."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.optimize import brentq

from safeswitch.handover.panel import Calibration, Panel
from safeswitch.handover.table import Ints
from safeswitch.protocols import Array, Calibrated, Driver
from safeswitch.seeding import stream
from safeswitch_baselines.rules.base import PlainMethod, SignalMethod, ThresholdRule
from safeswitch_baselines.rules.cem import CEM

REFERENCE = "total"
"""`random` and `periodic` are matched to the expert share of CEM on this signal."""

PERIOD = 20
"""Steps between the starts of two expert bursts of `periodic`."""


def reference_share(calibration: Calibration) -> tuple[float, Calibrated]:
    """Share of armed steps that the expert drives under `cem@total` on the calibrate episodes, and that calibration."""
    panel = calibration.panel
    reference = CEM(REFERENCE).calibrate(calibration)
    handover = panel.handover_of(reference.rule)
    armed = np.maximum(panel.table.horizon - panel.arming_step, 1)
    return float((panel.expert_share(handover) * panel.table.horizon / armed).mean()), reference


class RandomRule:
    """Latched: at each armed step hands over with probability `hazard`, blind to every signal."""

    def __init__(self, hazard: float):
        self.hazard = float(hazard)

    def reset(self, seed: int) -> None:
        """The draws are a function of the episode seed."""
        self._draws = stream(seed, "random-rule")
        self._driver = Driver.LEARNER

    def arm(self, step: int) -> Driver:
        """The learner drives."""
        return self._driver

    def update(self, step: int, signals: Mapping[str, float]) -> Driver:
        """One draw a step."""
        if self._draws.random() < self.hazard:
            self._driver = Driver.EXPERT
        return self._driver


class RandomControl(PlainMethod):
    """`random`: a constant hazard whose expected expert share is that of `cem@total` on the calibrate episodes."""

    family = "random"
    needs = frozenset({"failures", "rollouts"})

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Solve for the hazard."""
        share, reference = reference_share(calibration)
        panel = calibration.panel
        hazard = hazard_of(share, np.maximum(panel.table.horizon - panel.arming_step, 1))
        return Calibrated(RandomRule(hazard), hazard, reference.tuning_episodes, reference.expert_queries)


def hazard_of(share: float, armed: Ints) -> float:
    """Chance per step at which the expert drives `share` of the armed steps (E,) on average; 1 where it cannot."""

    def excess(hazard: float) -> float:
        return float(np.mean([_expected_share(hazard, int(steps)) for steps in armed])) - share

    return 0.0 if share <= 0 else 1.0 if excess(1.0) <= 0 else float(brentq(excess, 0.0, 1.0))


def _expected_share(hazard: float, steps: int) -> float:
    """Expected share of `steps` armed steps driven by the expert: step k is the expert's with 1 - (1 - hazard)^k."""
    return float(1.0 - ((1.0 - hazard) ** np.arange(steps)).mean())


class PeriodicRule:
    """Gives control back: the expert drives the last `burst` steps of each `PERIOD` armed steps."""

    def __init__(self, burst: int):
        self.burst = int(burst)

    def reset(self, seed: int) -> None:
        """`arm` sets the clock."""
        self._start = 0

    def arm(self, step: int) -> Driver:
        """Start the clock."""
        self._start = step
        return self._driver(step)

    def update(self, step: int, signals: Mapping[str, float]) -> Driver:
        """Driver of the next step by the clock."""
        return self._driver(step + 1)

    def _driver(self, step: int) -> Driver:
        return Driver.EXPERT if (step - self._start) % PERIOD >= PERIOD - self.burst else Driver.LEARNER


class PeriodicControl(PlainMethod):
    """`periodic`: bursts of the expert at the share of `cem@total` on the calibrate episodes. Gives control back."""

    family = "periodic"
    latched = False
    needs = frozenset({"failures", "rollouts"})

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Burst length to the nearest step."""
        share, reference = reference_share(calibration)
        burst = round(share * PERIOD)
        return Calibrated(PeriodicRule(burst), float(burst), reference.tuning_episodes, reference.expert_queries)


class _Shuffled:
    """Table rule: a threshold on the trace of another episode of the same kind, aligned at the arming step."""

    def __init__(self, signal: str, threshold: float):
        self.signal, self.threshold = signal, threshold

    def handover_steps(self, panel: Panel) -> Ints:
        return ThresholdRule(self.signal, self.threshold).handover_steps(shuffled(panel, self.signal))


class Shuffled(SignalMethod):
    """`shuffled@signal`: CEM on another seed's trace; what it earns, the signal's level earns without its timing."""

    family = "shuffled"
    needs = frozenset({"failures", "rollouts", "privileged"})

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """CEM with the traces shuffled, so that the control is as well calibrated as the rule."""
        panel = shuffled(calibration.panel, self.signal)
        learned = CEM(self.signal).calibrate(Calibration(panel, calibration.nominal, calibration.phi, calibration.seed))
        rule = _Shuffled(self.signal, learned.threshold)
        return replace(learned, rule=rule)


def shuffled(panel: Panel, signal: str) -> Panel:
    """The panel with each trace replaced by that of the next episode of its kind, aligned at the arming step."""
    trace, donor = panel.signal(signal), np.arange(len(panel))
    for kind in (panel.table.disturbed, ~panel.table.disturbed):
        donor[kind] = np.roll(donor[kind], 1)
    moved = np.full_like(trace, np.nan)
    for episode, other in enumerate(donor):
        moved[episode] = _aligned(trace[other], int(panel.arming_step[other]), int(panel.arming_step[episode]))
    return panel.with_signal(signal, moved)


def _aligned(trace: Array, source: int, target: int) -> Array:
    """`trace` moved in time so that its step `source` comes to stand at `target`; NaN where nothing is known."""
    moved = np.full_like(trace, np.nan)
    count = len(trace) - max(source, target)
    moved[target : target + count] = trace[source : source + count]
    return moved
