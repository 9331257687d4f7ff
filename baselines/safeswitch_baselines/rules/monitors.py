"""Monitors that learn from undisturbed episodes alone: conformal prediction and patience.

    conformal        one constant threshold      split conformal prediction on episode maxima
                                                 Vovk, Gammerman, Shafer 2005; Angelopoulos and Bates, arXiv 2107.07511
    conformal-band   one threshold per step      functional conformal band: Diquigiovanni, Fontana, Vantini, The
                                                 importance of being a band; FAIL-Detect: Xu et al., arXiv 2503.08558
    patience         a run of high values        Diff-DAgger: Lee, Kang, Kuo 2024, arXiv 2410.14868

None needs a failure or an expert. All are latched, and all call an alarm at the step after which they hand over.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from safeswitch.handover.panel import Calibration, Panel
from safeswitch.handover.table import HandoverTable, Ints
from safeswitch.protocols import Array, Calibrated, Driver
from safeswitch.seeding import stream
from safeswitch_baselines.rules.base import SignalMethod, ThresholdRule

ALPHA = 0.05
"""Chance of a false alarm per undisturbed episode that the conformal rules promise not to exceed."""
PATIENCE = 3
"""Consecutive steps of `patience`."""
PATIENCE_LEVEL = 0.99
"""Quantile of undisturbed steps that they must exceed."""


def conformal_quantile(scores: Array, alpha: float) -> float:
    """The k-th smallest of n scores, k = ceil((n + 1)(1 - alpha)); infinite where k > n: too few episodes to promise.

    One more exchangeable score is above it with a chance of at most alpha.
    """
    k = math.ceil((len(scores) + 1) * (1 - alpha))
    return float(np.sort(scores)[k - 1]) if k <= len(scores) else math.inf


def threshold_of(value: float) -> float:
    """As `Calibrated.threshold` has it: NaN where no finite threshold exists."""
    return value if math.isfinite(value) else math.nan


class Conformal(SignalMethod):
    """`conformal@signal`: the conformal quantile of episode maxima.

    Calibration: the score of an undisturbed calibrate episode is the maximum of its signal; the threshold is the k-th
    smallest of n scores, k = ceil((n + 1)(1 - alpha)), alpha = 0.05. With fewer than 19 episodes it never alarms.
    Decision: alarm at the first step with signal > threshold. Latched.
    Property: on exchangeable undisturbed episodes armed from the start, the share of false alarms is
    Beta(n + 1 - k, k) over calibrations (for a continuous signal), with mean (n + 1 - k) / (n + 1) <= alpha.
    """

    family = "conformal"

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Conformal quantile of the maxima."""
        table = calibration.nominal
        threshold = conformal_quantile(np.nanmax(table.signals[self.signal], axis=1), ALPHA)
        return Calibrated(ThresholdRule(self.signal, threshold), threshold_of(threshold), tuning_episodes=len(table))


class BandRule:
    """Latched: hands over once (signal - mean_t) / width_t > factor at an armed step t.

    Args:
        signal: its id.
        mean: (T,), in the signal's units, by environment step.
        width: (T,), positive, in the signal's units.
        factor: how many widths above the mean is too much.
    """

    def __init__(self, signal: str, mean: Array, width: Array, factor: float):
        self.signal, self.mean, self.width, self.factor = signal, mean, width, float(factor)
        self._driver = Driver.LEARNER

    def reset(self, seed: int) -> None:
        """Give the learner control."""
        self._driver = Driver.LEARNER

    def arm(self, step: int) -> Driver:
        """Nothing was measured yet while armed: the learner drives."""
        return self._driver

    def update(self, step: int, signals: Mapping[str, float]) -> Driver:
        """Alarm above the band."""
        if (signals[self.signal] - self.mean[step]) / self.width[step] > self.factor:
            self._driver = Driver.EXPERT
        return self._driver

    def handover_steps(self, panel: Panel) -> Ints:
        """(E,) handover steps on a table, all episodes at once."""
        scores = band_scores(panel.signal(self.signal), self.mean, self.width)
        return panel.with_signal(self.signal, scores).handover_at(self.signal, np.array([self.factor]))[0]


def band_scores(trace: Array, mean: Array, width: Array) -> Array:
    """(E, T) distance above the mean in widths."""
    return (trace - mean) / width


def step_profile(trace: Array, window: int = 0) -> tuple[Array, Array]:
    """Mean and standard deviation (T,) of traces (E, T) at every step, pooled over `window` steps to either side.

    Steps that no trace reaches have the values of the last one that some do. Nowhere is the deviation below a
    hundredth of its mean over the steps: a signal that happens to be constant at a step says nothing about its width.
    """
    horizon = trace.shape[1]
    means, widths = np.empty(horizon), np.empty(horizon)
    for step in range(horizon):
        values = trace[:, max(step - window, 0) : step + window + 1]
        values = values[~np.isnan(values)]
        if values.size:
            means[step], widths[step] = values.mean(), values.std()
        else:
            means[step], widths[step] = means[step - 1], widths[step - 1]
    floor = 0.01 * float(widths.mean())
    return means, np.maximum(widths, floor if floor > 0 else 1.0)


class ConformalBand(SignalMethod):
    """`conformal-band@signal`: a band above the mean course of the signal, one-sided, of the right width in every step.

    Calibration: the undisturbed calibrate episodes are split at random in two halves. The first gives mean_t and the
    modulation width_t, the standard deviation at step t (the sources offer it beside one made of trimmed maxima). The
    second gives the factor: the conformal quantile, alpha = 0.05, of the scores max_t (signal_t - mean_t) / width_t.
    Decision: alarm at the first step with signal_t > mean_t + factor width_t, t counted from the start of the episode
    whatever the arming. Latched. Needs 19 episodes in the second half, or never alarms.
    """

    family = "conformal-band"

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Band on one half, its factor on the other."""
        table = calibration.nominal
        trace = table.signals[self.signal]
        first, second = halves(table, calibration.seed, self.id)
        mean, width = step_profile(trace[first])
        scores = np.nanmax(band_scores(trace[second], mean, width), axis=1)
        factor = conformal_quantile(scores, ALPHA)
        rule = BandRule(self.signal, mean, width, factor)
        return Calibrated(rule, threshold_of(factor), len(table), log={"mean": mean, "width": width})


def halves(table: HandoverTable, seed: int, name: str) -> tuple[Ints, Ints]:
    """Episodes of a table in two random halves, the second one the larger."""
    order = stream(seed, "halves", name).permutation(len(table))
    first, second = np.split(order, [max(len(table) // 2, 1)])
    return np.sort(first), np.sort(second)


class PatienceRule:
    """Latched: hands over once the signal was above the threshold at `patience` consecutive armed steps."""

    def __init__(self, signal: str, threshold: float, patience: int):
        self.signal, self.threshold, self.patience = signal, float(threshold), int(patience)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Give the learner control."""
        self._driver, self._run = Driver.LEARNER, 0

    def arm(self, step: int) -> Driver:
        """Steps before the arming step do not count."""
        self._run = 0
        return self._driver

    def update(self, step: int, signals: Mapping[str, float]) -> Driver:
        """Count, and alarm when the run is long enough."""
        self._run = self._run + 1 if signals[self.signal] > self.threshold else 0
        if self._run >= self.patience:
            self._driver = Driver.EXPERT
        return self._driver


class Patience(SignalMethod):
    """`patience@signal`: Diff-DAgger's decision on any signal.

    Calibration: the threshold is the 99 % quantile of the signal over all steps of undisturbed calibrate episodes. The
    source takes the quantile of its training loss; on training data the uncertainty of a network is too low.
    Decision: alarm when the signal exceeds it for 3 consecutive steps. Latched here (the source's gate is a person's).
    """

    family = "patience"

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Quantile over steps."""
        table = calibration.nominal
        threshold = float(np.nanquantile(table.signals[self.signal], PATIENCE_LEVEL))
        return Calibrated(PatienceRule(self.signal, threshold, PATIENCE), threshold, tuning_episodes=len(table))
