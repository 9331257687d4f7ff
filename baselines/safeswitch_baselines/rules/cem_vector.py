"""Ours: CEM over the weights of several signals, their normalisation, their smoothing, and the threshold.

    x_i    = log signal_i
    z_i    = b (x_i - m_i,t) / d_i,t + (1 - b) (x_i - m_i) / d_i      m, d: mean and deviation in undisturbed episodes,
    z      = sum_i w_i z_i                                            of step t and its neighbours, and of all steps
    y_t    = a y_t-1 + (1 - a) z_t                                    from the arming step on
    alarm    y_t + c (t - t_armed) / T > theta

The cross-entropy method searches softmax(w), logit b, logit a, c and theta together, by the returns that the exact
handover table has for the calibrate episodes. It spends no more episodes than `cem@` does. A signal that is ordinarily
high in one phase of the task, as the paper's is while the pole swings up, is compared with that phase (b); several
signals are listened to at once (w); and the price of waiting may grow with time (c).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from safeswitch.handover.panel import Calibration, Panel
from safeswitch.handover.table import HandoverTable, Ints
from safeswitch.protocols import Array, Calibrated, Driver
from safeswitch.seeding import stream
from safeswitch_baselines.rules.base import PlainMethod, expert_steps
from safeswitch_baselines.rules.cem import EpisodeSampler
from safeswitch_baselines.rules.give_back import LEVEL, Dwell
from safeswitch_baselines.rules.monitors import step_profile
from safeswitch_baselines.signals.smoothing import split_id

SMALLEST = 1e-6
"""Signals are read as logarithms; smaller values count as this."""
UNHEARD = ("aleatoric", "discrepancy")
"""Left out: `total` has the one, and the other says where the learner errs in what it knows. Fewer weights are learned
from as many episodes."""
WINDOW = 2
"""Steps to either side that are pooled for the mean and the deviation of a step."""
NARROWEST = 0.25
"""The deviation of a step is at least this share of that of all steps."""


@dataclass(frozen=True)
class Settings:
    """Free parameters of the search, chosen on calibrate episodes of the cart-pole: one half of a disturbance's against
    the other, and those of all other disturbances against its own.

    Attributes:
        candidates: drawn per iteration.
        elites: how many of the best refit the distribution: half of them, as in `cem@`, so that the search settles in
            the middle of what works. With a quarter it settles near the edge of what it has seen, where a disturbance
            that it has not seen fails.
        iterations: of the search.
        episodes: shared by the candidates of an iteration; 2 x under `start`, half of them
            undisturbed. Few candidates on many episodes generalise better than the reverse.
        smoothing: weight of the refit against the value of before.
        floor: smallest standard deviation of every parameter but theta.
        theta_floor: that of theta.
        average: the result is the mean of this many last iterations.
        theta: initial mean of the threshold, in standard deviations.
        memory: initial mean of logit a.
        blend: initial mean of logit b.
    """

    candidates: int = 16
    elites: int = 8
    iterations: int = 10
    episodes: int = 64
    smoothing: float = 0.5
    floor: float = 0.3
    theta_floor: float = 0.75
    average: int = 5
    theta: float = 2.0
    memory: float = -1.0
    blend: float = 1.0


def vector_signals(names: Mapping[str, object]) -> tuple[str, ...]:
    """The recorded signals that are weighed, sorted: unsmoothed ones but for `UNHEARD`."""
    return tuple(sorted(name for name in names if split_id(name)[1] is None and name not in UNHEARD))


@dataclass(frozen=True)
class Baseline:
    """What is ordinary: logarithms of the signals in undisturbed episodes.

    Attributes:
        names: ids of the n signals.
        mean, scale: (n,) over all steps.
        step_mean, step_scale: (T, n) around each step.
    """

    names: tuple[str, ...]
    mean: Array
    scale: Array
    step_mean: Array
    step_scale: Array

    @classmethod
    def fit(cls, nominal: HandoverTable) -> Baseline:
        """Mean and deviation over undisturbed episodes."""
        names = vector_signals(nominal.signals)
        logs = _logarithms(nominal.signals, names)
        mean, scale = np.nanmean(logs, axis=(0, 1)), np.nanstd(logs, axis=(0, 1))
        scale = np.where(scale > 1e-9, scale, 1.0)
        steps = [step_profile(logs[..., i], WINDOW) for i in range(len(names))]
        means, scales = (np.stack(column, axis=-1) for column in zip(*steps, strict=True))
        return cls(names, mean, scale, means, np.maximum(scales, NARROWEST * scale))

    def standardised(self, panel: Panel) -> tuple[Array, Array]:
        """(E, T, n) logarithms in deviations from the mean of all steps, and of each step."""
        logs = _logarithms(panel.table.signals, self.names)
        return (logs - self.mean) / self.scale, (logs - self.step_mean) / self.step_scale


def _logarithms(signals: Mapping[str, Array], names: tuple[str, ...]) -> Array:
    return np.log(np.maximum(np.stack([signals[name] for name in names], axis=-1), SMALLEST))


@dataclass(frozen=True)
class Parameters:
    """What the search finds: weights (n,) that add up to 1, blend b, memory a, slope c and threshold theta."""

    weights: Array
    blend: float
    memory: float
    slope: float
    theta: float

    @classmethod
    def of(cls, point: Array) -> Parameters:
        """From a point (n + 4,) of the search space."""
        *raw, blend, memory, slope, theta = point.tolist()
        powers = np.exp(np.array(raw) - max(raw))
        return cls(powers / powers.sum(), _logistic(blend), _logistic(memory), slope, theta)


def _logistic(value: float) -> float:
    return 1.0 / (1.0 + math.exp(-min(max(value, -30.0), 30.0)))


def alarms(panel: Panel, standardised: tuple[Array, Array], points: Array) -> Ints:
    """(C, E) handover steps for points (C, n + 4) of the search space; T where there is no alarm."""
    found = [Parameters.of(point) for point in points]
    columns = zip(*((each.blend, each.memory, each.slope, each.theta) for each in found), strict=True)
    blend, memory, slope, theta = (np.array(column)[:, None] for column in columns)
    weights = np.stack([each.weights for each in found])
    overall, by_step = standardised
    z = blend[..., None] * np.einsum("etn,cn->cet", by_step, weights)
    z += (1 - blend[..., None]) * np.einsum("etn,cn->cet", overall, weights)
    horizon, armed = panel.table.horizon, panel.arming_step[None, :]
    handover = np.full(z.shape[:2], horizon)
    y = np.zeros(z.shape[:2])
    for step in range(horizon):
        y = np.where(step > armed, memory * y + (1 - memory) * z[..., step], z[..., step])
        alarm = (y + slope * ((step - armed) / horizon) > theta) & (step >= armed) & (handover == horizon)
        handover[alarm] = step + 1
    return panel.executed(handover)


class Score:
    """The value y_t + c (t - t_armed) / T of one episode, step by step."""

    def __init__(self, baseline: Baseline, parameters: Parameters, horizon: int):
        self.baseline, self.parameters, self.horizon = baseline, parameters, horizon
        self._weights = parameters.weights.tolist()

    def arm(self, step: int) -> None:
        """Start at this step, without a memory."""
        self._start, self._y = step, math.nan

    def value(self, step: int, signals: Mapping[str, float]) -> float:
        """Value at an armed step; called once at each."""
        base, p = self.baseline, self.parameters
        z = 0.0
        for i, name in enumerate(base.names):
            x = math.log(max(signals[name], SMALLEST))
            by_step = (x - float(base.step_mean[step, i])) / float(base.step_scale[step, i])
            overall = (x - float(base.mean[i])) / float(base.scale[i])
            z += self._weights[i] * (p.blend * by_step + (1 - p.blend) * overall)
        self._y = z if step <= self._start else p.memory * self._y + (1 - p.memory) * z
        return self._y + p.slope * ((step - self._start) / self.horizon)


class VectorRule:
    """Latched: hands over once the score is above theta."""

    def __init__(self, score: Score):
        self.score = score
        self.reads = score.baseline.names
        self._driver = Driver.LEARNER

    def reset(self, seed: int) -> None:
        """Give the learner control."""
        self._driver = Driver.LEARNER

    def arm(self, step: int) -> Driver:
        """Nothing was measured yet while armed: the learner drives."""
        self.score.arm(step)
        return self._driver

    def update(self, step: int, signals: Mapping[str, float]) -> Driver:
        """Alarm if the score is above theta."""
        if self.score.value(step, signals) > self.score.parameters.theta:
            self._driver = Driver.EXPERT
        return self._driver


class VectorDwell(Dwell):
    """Gives control back: two thresholds on the score, with a dwell."""

    def __init__(self, score: Score, lower: float):
        self.score = score
        self.reads = score.baseline.names
        super().__init__(score.parameters.theta, lower)

    def arm(self, step: int) -> Driver:
        """Start the score."""
        self.score.arm(step)
        return super().arm(step)

    def value(self, step: int, signals: Mapping[str, float]) -> float:
        """The score."""
        return self.score.value(step, signals)


def learn(calibration: Calibration, settings: Settings, name: str) -> tuple[Score, Calibrated]:
    """The cross-entropy method on the calibrate episodes; `name` keys its random numbers."""
    panel = calibration.panel
    baseline = Baseline.fit(calibration.nominal)
    rng = stream(calibration.seed, "cem-vector", name, panel.arming)
    sampler = EpisodeSampler(panel, settings.episodes * (1 if panel.arming == "onset" else 2), rng)
    mu = np.array([0.0] * len(baseline.names) + [settings.blend, settings.memory, 0.0, settings.theta])
    sigma = np.array([1.0] * len(baseline.names) + [2.0, 1.0, 1.0, 1.5])
    floor = np.array([settings.floor] * (len(mu) - 1) + [settings.theta_floor])
    samples, returned, means, queries = [], [], [], 0
    for _ in range(settings.iterations):
        points = rng.normal(mu, sigma, (settings.candidates, len(mu)))
        shared = sampler.draw()
        handover = alarms(shared, baseline.standardised(shared), points)
        returns = shared.returns(handover, calibration.phi).mean(axis=1)
        queries += expert_steps(shared, handover)
        elite = points[np.argsort(-returns, kind="stable")[: settings.elites]]
        mu = mu + settings.smoothing * (elite.mean(axis=0) - mu)
        sigma = np.maximum(sigma + settings.smoothing * (elite.std(axis=0) - sigma), floor)
        samples.append(points)
        returned.append(returns)
        means.append(mu)
    score = Score(baseline, Parameters.of(np.mean(means[-settings.average :], axis=0)), panel.table.horizon)
    log = {"samples": np.stack(samples), "sample_return": np.stack(returned), "mu": np.stack(means)}
    cost = settings.iterations * settings.candidates * len(shared)
    return score, Calibrated(VectorRule(score), score.parameters.theta, cost, queries, log)


class CEMVector(PlainMethod):
    """`cem-vector`: latched; weights, normalisation, smoothing and threshold by CEM on the exact table.

    It reads every unsmoothed signal that the task records. Decision: alarm where the module's score is above theta.
    Calibration: 10 iterations of 16 candidates on 64 calibrate episodes, 128 under `start`: the number of episodes that
    `cem@` spends without repetitions. The baseline comes from undisturbed calibrate episodes.
    """

    family = "cem-vector"
    needs = frozenset({"failures", "rollouts"})

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Search."""
        return learn(calibration, Settings(), self.family)[1]


class CEMVectorReturn(PlainMethod):
    """`cem-vector-return`: the same score and threshold; control is given back after a while of ordinary scores.

    Return: learner after 10 consecutive steps with a score at or below its median over undisturbed calibrate episodes.
    """

    family = "cem-vector-return"
    latched = False
    needs = frozenset({"failures", "rollouts"})

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Search as `cem-vector`, then take the median."""
        score, learned = learn(calibration, Settings(), CEMVector.family)
        lower = float(np.quantile(_undisturbed_scores(score, calibration.nominal), LEVEL))
        rule = VectorDwell(score, lower)
        return Calibrated(rule, learned.threshold, learned.tuning_episodes, learned.expert_queries, learned.log)


def _undisturbed_scores(score: Score, nominal: HandoverTable) -> Array:
    """Scores at every step of undisturbed episodes, armed from the start."""
    values = []
    for episode, length in enumerate(nominal.length):
        score.arm(0)
        for step in range(int(length)):
            signals = {name: float(nominal.signals[name][episode, step]) for name in score.baseline.names}
            values.append(score.value(step, signals))
    return np.array(values)
