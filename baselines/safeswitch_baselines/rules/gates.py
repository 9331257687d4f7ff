"""The gates of interactive imitation learning (DAgger and its successors): they give control back.

    safe-dagger       expert where a classifier calls the learner unsafe       Zhang and Cho 2017, arXiv 1605.06450
    lazy              the same, until the learner's action is the expert's     Hoque et al. 2021, arXiv 2104.00053
    ensemble-dagger   expert where doubt or discrepancy is high                Menda et al. 2019, arXiv 1807.08364
    thrifty           expert where novelty or risk is high                     Hoque et al. 2021, arXiv 2109.08273

The sources use them to decide where to ask for labels and then train again; here the learner stays as it is and the
gate is judged as a switch rule. As everywhere in this suite a decision at step t holds from step t + 1 on.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from safeswitch.handover.episode import DEVIATION
from safeswitch.handover.panel import Calibration, Panel
from safeswitch.protocols import Calibrated, Driver
from safeswitch_baselines.rules.base import SignalMethod
from safeswitch_baselines.rules.risk import RiskCritic
from safeswitch_baselines.signals.discrepancy import TAU


class Gate:
    """Gives control back: the expert drives from the step after `enters` until the step after `leaves`."""

    signal: str

    @property
    def reads(self) -> tuple[str, ...]:
        """Ids of the signals that it looks at; no other one need be computed."""
        return (self.signal,)

    def reset(self, seed: int) -> None:
        """Give the learner control."""
        self._driver = Driver.LEARNER

    def arm(self, step: int) -> Driver:
        """Nothing was measured yet while armed: the learner drives."""
        return self._driver

    def update(self, step: int, signals: Mapping[str, float]) -> Driver:
        """Ask what the driver's turn ends with."""
        if self._driver is Driver.LEARNER:
            self._driver = Driver.EXPERT if self.enters(step, signals) else Driver.LEARNER
        else:
            self._driver = Driver.LEARNER if self.leaves(step, signals) else Driver.EXPERT
        return self._driver

    def enters(self, step: int, signals: Mapping[str, float]) -> bool:
        """Whether the expert takes over from the learner."""
        raise NotImplementedError

    def leaves(self, step: int, signals: Mapping[str, float]) -> bool:
        """Whether the expert gives control back."""
        raise NotImplementedError


class OnDiscrepancy(SignalMethod):
    """Base of the gates on the classifier that `discrepancy` is; smoothed versions of it will do."""

    latched = False

    def __init__(self, signal: str | None):
        super().__init__(signal)
        if self.signal.partition("-")[0] != "discrepancy":
            raise ValueError(f"method {self.family!r} reads a classifier: write '{self.family}@discrepancy'")


class SafetyGate(Gate):
    """Expert exactly while the chance of an unsafe action is above one half."""

    def __init__(self, signal: str):
        self.signal = signal
        self.reset(0)

    def enters(self, step: int, signals: Mapping[str, float]) -> bool:
        """Called unsafe."""
        return signals[self.signal] > 0.5

    def leaves(self, step: int, signals: Mapping[str, float]) -> bool:
        """Called safe."""
        return signals[self.signal] <= 0.5


class SafeDAgger(OnDiscrepancy):
    """`safe-dagger@discrepancy`: the expert drives while the safety classifier says that the learner deviates.

    Calibration: none beyond the classifier, which is fitted to the trunk features of the demonstrations (signal
    `discrepancy`). Decision: expert where P(|a_learner - a_expert| > tau) > 1/2. Return: learner where it is not.
    """

    family = "safe-dagger"

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Nothing to choose: the classifier's own boundary."""
        return Calibrated(SafetyGate(self.signal), 0.5)


class LazyGate(Gate):
    """Hysteresis: expert once called unsafe, until the learner's action is within `close` of the expert's."""

    def __init__(self, signal: str, close: float):
        self.signal, self.close = signal, float(close)
        self.reset(0)

    def enters(self, step: int, signals: Mapping[str, float]) -> bool:
        """Called unsafe."""
        return signals[self.signal] > 0.5

    def leaves(self, step: int, signals: Mapping[str, float]) -> bool:
        """The true deviation, known while the expert drives, is small."""
        return signals[DEVIATION] < self.close


LAZY_RATIO = 4.0
"""beta_H / beta_R of LazyDAgger, for squared deviations: the default of its authors' code (`tau_auto` = 0.25 in
https://github.com/ryanhoque/thriftydagger, thrifty/algos/lazydagger.py), which they call a knob to tune."""


class LazyDAgger(OnDiscrepancy):
    """`lazy@discrepancy`: SafeDAgger's classifier to take over, the true deviation to give back.

    Calibration: none; beta_H = tau^2 is the classifier's, beta_R = beta_H / 4, the ratio of the authors' code.
    Decision: expert where P(|a_learner - a_expert|^2 > beta_H) > 1/2. Return: learner once the true
    |a_learner - a_expert|^2 < beta_R; the expert drives then, so that its action is known without asking.
    """

    family = "lazy"

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Nothing to choose."""
        return Calibrated(LazyGate(self.signal, TAU / LAZY_RATIO**0.5), 0.5)


class EnsembleGate(Gate):
    """Expert exactly while doubt or deviation is high; the deviation must be known at every step."""

    def __init__(self, signal: str, doubt: float, deviation: float):
        self.signal, self.doubt, self.deviation = signal, float(doubt), float(deviation)
        self.reset(0)

    def enters(self, step: int, signals: Mapping[str, float]) -> bool:
        """Not both safe."""
        return signals[self.signal] > self.doubt or signals[DEVIATION] > self.deviation

    def leaves(self, step: int, signals: Mapping[str, float]) -> bool:
        """Both safe."""
        return not self.enters(step, signals)


class EnsembleDAgger(SignalMethod):
    """`ensemble-dagger@signal`: learner only where both the doubt and the discrepancy are low. Privileged.

    Calibration: chi, the bound on the doubt (the signal; the source's is the variance of an ensemble, or of dropout),
    is the 99 % quantile of undisturbed steps; the bound on the discrepancy is tau. The source sets both by hand.
    Decision: expert where signal > chi or |a_learner - a_expert| > tau. Return: learner where neither holds.
    The discrepancy is the true one, so that the expert is asked at every step: privileged.
    """

    family = "ensemble-dagger"
    latched = False
    needs = frozenset({"expert-queries", "privileged"})

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Quantile over steps."""
        doubt = float(np.nanquantile(calibration.nominal.signals[self.signal], 0.99))
        return Calibrated(EnsembleGate(self.signal, doubt, TAU), doubt, len(calibration.nominal))


class ThriftyGate(Gate):
    """Expert once novelty or risk is high, until the learner agrees with it and the risk is ordinary again."""

    def __init__(self, signal: str, critic: RiskCritic, novelty: float, risk: float, ordinary: float, close: float):
        self.signal, self.critic = signal, critic
        self.novelty, self.risk, self.ordinary, self.close = novelty, risk, ordinary, close
        self.reset(0)

    @property
    def reads(self) -> tuple[str, ...]:
        """The signal, and those of the critic."""
        return (self.signal, *self.critic.names)

    def enters(self, step: int, signals: Mapping[str, float]) -> bool:
        """Novel or risky."""
        return signals[self.signal] > self.novelty or self.critic.risk(step, signals) > self.risk

    def leaves(self, step: int, signals: Mapping[str, float]) -> bool:
        """Close to the expert and not risky."""
        return signals[DEVIATION] < self.close and self.critic.risk(step, signals) <= self.ordinary


class ThriftyDAgger(SignalMethod):
    """`thrifty@signal`: novelty or risk to take over, agreement and ordinary risk to give back.

    Calibration: the novelty is the signal. The risk is 1 - P(the learner alone succeeds), learned from the learner-only
    calibrate episodes; the source's critic reads state and action, which no rule of this suite sees: ours reads all
    signals and the step (`RiskCritic`). With the source's alpha = 0.01, delta_h and beta_h are the 1 - alpha quantiles
    of novelty and risk over undisturbed steps, and beta_r is the median of the risk.
    Decision: expert where novelty > delta_h or risk > beta_h. Return: learner once |a_learner - a_expert| < tau and
    risk <= beta_r. The expert drives then, so that its action is known without asking. The bound on agreement in the
    authors' code is the mean squared deviation over the training data, which no rule of this suite sees.
    """

    family = "thrifty"
    latched = False
    needs = frozenset({"failures", "rollouts"})
    alpha = 0.01

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Fit the critic, then take quantiles."""
        panel, nominal = calibration.panel, calibration.nominal
        critic = RiskCritic.fit(panel)
        risk = critic.risks(Panel(nominal, "start"))
        novelty = float(np.nanquantile(nominal.signals[self.signal], 1 - self.alpha))
        high, ordinary = (float(np.nanquantile(risk, level)) for level in (1 - self.alpha, 0.5))
        rule = ThriftyGate(self.signal, critic, novelty, high, ordinary, TAU)
        return Calibrated(rule, novelty, len(panel), log=critic.log())
