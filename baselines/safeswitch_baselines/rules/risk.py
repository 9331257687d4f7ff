"""What a step's signals say about the end of an episode: the chance that the learner alone fails."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from safeswitch.handover.panel import Panel
from safeswitch.handover.table import Bools
from safeswitch.protocols import Array

SMALLEST = 1e-6
"""Signals are read as logarithms; smaller values count as this."""
RIDGE = 1e-3
"""Weight of the squared coefficients, per sample."""
STEPS = 25
"""Newton steps at most; the problem is convex and takes about eight."""


@dataclass(frozen=True)
class RiskCritic:
    """Logistic regression of failure on the logarithms of all signals and the share of the episode that has passed.

    Attributes:
        names: ids of the signals, sorted.
        horizon: T [steps].
        mean: (n,) of the regressors in the episodes it was fitted to.
        scale: (n,) their standard deviation.
        weights: (n,) of the standardised regressors.
        bias: log-odds of failure at the mean.
    """

    names: tuple[str, ...]
    horizon: int
    mean: Array
    scale: Array
    weights: Array
    bias: float

    @classmethod
    def fit(cls, panel: Panel) -> RiskCritic:
        """Fit to every armed step of learner-only episodes; the label of a step is how its episode ends."""
        names, horizon = tuple(sorted(panel.table.signals)), panel.table.horizon
        x, known = _regressors(panel, names)
        armed = known & (np.arange(horizon)[None, :] >= panel.arming_step[:, None])
        inputs = x[armed]
        failed = np.broadcast_to(~panel.table.learner_success[:, None], armed.shape)[armed].astype(float)
        mean, scale = inputs.mean(axis=0), inputs.std(axis=0)
        scale = np.where(scale > 1e-9, scale, 1.0)
        *weights, bias = _logistic((inputs - mean) / scale, failed)
        return cls(names, horizon, mean, scale, np.array(weights), float(bias))

    def risk(self, step: int, signals: Mapping[str, float]) -> float:
        """Chance of failure at one step."""
        values = [*(math.log(max(signals[name], SMALLEST)) for name in self.names), step / self.horizon]
        return _sigmoid(math.fsum(self.weights * (np.array(values) - self.mean) / self.scale) + self.bias)

    def risks(self, panel: Panel) -> Array:
        """(E, T) chance of failure at every step, NaN after an early end."""
        x, known = _regressors(panel, self.names)
        z = ((x - self.mean) / self.scale) @ self.weights + self.bias
        return np.where(known, 1.0 / (1.0 + np.exp(-np.clip(z, -50.0, 50.0))), np.nan)

    def log(self) -> dict[str, Array]:
        """The fit, for the record."""
        return {"mean": self.mean, "scale": self.scale, "weights": np.append(self.weights, self.bias)}


def _regressors(panel: Panel, names: tuple[str, ...]) -> tuple[Array, Bools]:
    """(E, T, n) regressors, and (E, T) where they are known."""
    traces = [panel.signal(name) for name in names]
    known: Bools = np.isfinite(np.stack(traces).sum(axis=0))
    time = np.broadcast_to(np.arange(panel.table.horizon) / panel.table.horizon, known.shape)
    logs = [np.log(np.maximum(np.where(known, trace, 1.0), SMALLEST)) for trace in traces]
    return np.stack([*logs, time], axis=-1), known


def _logistic(inputs: Array, labels: Array) -> Array:
    """Coefficients (n + 1,), the constant last, of ridge logistic regression, by Newton's method."""
    x = np.concatenate([inputs, np.ones((len(inputs), 1))], axis=1)
    penalty = RIDGE * np.append(np.ones(inputs.shape[1]), 1e-6 / RIDGE)  # the constant is hardly shrunk
    beta = np.zeros(x.shape[1])
    for _ in range(STEPS):
        p = 1.0 / (1.0 + np.exp(-np.clip(np.einsum("ij,j->i", x, beta), -30.0, 30.0)))
        slope = np.einsum("ij,i->j", x, labels - p) / len(x) - penalty * beta
        curvature = np.einsum("ij,i,ik->jk", x, p * (1 - p), x, optimize=True) / len(x) + np.diag(penalty)
        change = np.clip(np.linalg.solve(curvature, slope), -2.0, 2.0)
        beta += change
        if np.abs(change).max() < 1e-10:
            break
    return beta


def _sigmoid(value: float) -> float:
    return 1.0 / (1.0 + math.exp(-min(max(value, -50.0), 50.0)))
