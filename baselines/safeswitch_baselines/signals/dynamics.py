"""Surprise: how badly a model of the trunk features, learned from the demonstrations, predicts the next step.

    z      = whitened principal components of the trunk features
    z_t+1 ~= A' [1, z_t, a_t, cos(Omega [z_t, a_t] + phase)]     ridge regression with random Fourier features
    value  = |W (z_t+1 - prediction)|^2 / k, W' W = inverse covariance of the residuals in training

One-step prediction error as novelty: Pathak et al. 2017, arXiv 1705.05363. Random Fourier features: Rahimi and Recht
2007. The action a_t is the one that was executed, whoever drove.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safeswitch.protocols import Array, Prediction, TrainingFeatures
from safeswitch.seeding import stream
from safeswitch_baselines.signals.features import Floats, norm, product, trunk_features


class DynamicsResidual:
    """Whitened, squared one-step prediction error on the trunk features [-]; 0 at step 0, which nothing predicts.

    Its mean over the training steps is about 1; k is the number of principal axes.

    Args:
        arrays: `mean` (d,), `axes` (k, d), `omega` (h, k + nu), `phase` (h,), `model` (k, 1 + k + nu + h) and
            `whitening` (k, k).
    """

    id = "dynamics-residual"
    axes, lift, ridge = 32, 256, 1e-4

    def __init__(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        self._mean, self._axes = arrays["mean"], arrays["axes"]
        self._omega, self._phase = arrays["omega"], arrays["phase"]
        self._model, self._whitening = arrays["model"], arrays["whitening"]
        self.reset()

    @classmethod
    def fit(cls, training: TrainingFeatures, seed: int) -> dict[str, NDArray[Any]]:
        """Axes, model and residual covariance from neighbouring steps of an episode; `seed` draws Omega and phase."""
        from safeswitch_baselines.signals import fitting

        mean, axes = fitting.principal_axes(training.features, cls.axes)
        points = fitting.project(training.features, mean, axes)
        before = np.flatnonzero(training.episodes[1:] == training.episodes[:-1])
        if not len(before):
            raise ValueError("signal 'dynamics-residual' needs demonstrations of at least two steps an episode")
        inputs = np.concatenate([points, training.executed.astype(np.float32)], axis=1)[before]
        omega, phase = _draw_lift(seed, cls.lift, inputs.shape[1])
        angles = fitting.project(inputs, np.zeros(inputs.shape[1], np.float32), omega) + phase
        model, residuals = fitting.ridge(_regressors(inputs, angles), points[before + 1], cls.ridge)
        spread = fitting.ledoit_wolf(residuals).covariance
        whitening = fitting.whitening(spread).astype(np.float32)
        return {"mean": mean, "axes": axes, "omega": omega, "phase": phase, "model": model, "whitening": whitening}

    def reset(self) -> None:
        """Forget the step before."""
        self._before: Floats | None = None

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        """Value at this step: the error of what was predicted one step before."""
        point = product(self._axes, trunk_features(self.id, prediction, len(self._mean)) - self._mean)
        before, self._before = self._before, point
        if before is None or previous_action is None:
            return 0.0
        inputs = np.concatenate([before, np.asarray(previous_action, np.float32)])
        regressors = _regressors(inputs[None], (product(self._omega, inputs) + self._phase)[None])[0]
        return norm(product(self._whitening, point - product(self._model, regressors))) ** 2 / len(point)


def _draw_lift(seed: int, count: int, size: int) -> tuple[Floats, Floats]:
    """Frequencies (count, size) and phases (count,) of a Gaussian kernel as wide as its inputs are apart."""
    rng = stream(seed, "dynamics-lift")
    omega = rng.standard_normal((count, size)) / np.sqrt(size)
    return omega.astype(np.float32), rng.uniform(0.0, 2.0 * np.pi, count).astype(np.float32)


def _regressors(inputs: Floats, angles: Floats) -> Floats:
    """(n, 1 + m + h): one, the inputs (n, m) themselves, and the cosines of the angles (n, h)."""
    return np.concatenate([np.ones((len(inputs), 1), np.float32), inputs, np.cos(angles)], axis=1)
