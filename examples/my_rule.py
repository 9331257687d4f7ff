"""A switch rule of one's own: hand over when the signal has risen for three steps, or is far above what is usual.

The usual is learned from undisturbed calibrate episodes: no failure and no expert is needed.
"""

import numpy as np

from safeswitch.protocols import Calibrated, Driver

PATIENCE = 3


class Rising:
    """Satisfies `safeswitch.protocols.SwitchRule`. Latched: once the expert drives it drives to the end."""

    def __init__(self, signal, usual, far):
        self.signal, self.usual, self.far = signal, usual, far

    def reset(self, seed):
        """Start an episode with the learner."""
        self.driver, self.before, self.risen = Driver.LEARNER, np.inf, 0

    def arm(self, step):
        """The learner drives the step at which the monitor is switched on."""
        return self.driver

    def update(self, step, signals):
        """The driver of the next step, from the signals of this one."""
        value = signals[self.signal]
        self.risen = self.risen + 1 if value > max(self.before, self.usual) else 0
        self.before = value
        if value > self.far or self.risen >= PATIENCE:
            self.driver = Driver.EXPERT
        return self.driver


class RisingSignal:
    """Satisfies `safeswitch.protocols.Method`: `safeswitch evaluate --rule my_rule:RisingSignal@total`."""

    id = "rising"
    needs = frozenset()  # neither failures nor the expert
    latched = True

    def __init__(self, signal):
        self.signal = signal

    def calibrate(self, calibration):
        """Quantiles of the signal at the steps of undisturbed episodes."""
        values = calibration.nominal.signals[self.signal]
        usual, far = np.nanquantile(values, [0.95, 0.9995])
        return Calibrated(Rising(self.signal, usual, 1.5 * far), threshold=far)
