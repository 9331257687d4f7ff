"""A learner in plain NumPy: Bayesian linear regression on random Fourier features, one model an action.

    f(z)          = sqrt(2 / m) cos(W z + b)                      Rahimi & Recht 2007
    Sigma         = (F' F / s^2 + I / a^2)^-1                     posterior of the weights
    action        = f' m,   m = Sigma F' y / s^2
    epistemic_var = f' Sigma f                                    the weights are not known
    aleatoric_var = s^2                                           the labels are noisy: mean squared residual

Nothing here imports the benchmark: a learner is whatever has `reset` and `predict`, and `make` says how it is made.
"""

from dataclasses import dataclass

import numpy as np

FEATURES, SCALE, PRIOR = 600, 0.5, 1.0


@dataclass(frozen=True)
class Prediction:
    """What `predict` returns; `safeswitch.protocols.Prediction` would do as well."""

    action: np.ndarray
    epistemic_var: np.ndarray
    aleatoric_var: np.ndarray
    features: np.ndarray | None = None


class FourierLearner:
    """Satisfies `safeswitch.protocols.Learner`."""

    def __init__(self, demonstrations, seed):
        rng = np.random.default_rng(seed)
        x = self._scaled_by(np.asarray(demonstrations.observations, float))
        y = demonstrations.actions
        self.frequencies = SCALE * rng.standard_normal((FEATURES, x.shape[1]))
        self.phases = rng.uniform(0, 2 * np.pi, FEATURES)
        lifted = self._lift(x)
        gram, moment = lifted.T @ lifted, lifted.T @ y
        self.noise = 1e-2
        for _ in range(3):  # the noise and the fit depend on one another
            precision = gram / self.noise + np.eye(len(gram)) / PRIOR
            self.mean = np.linalg.solve(precision, moment / self.noise)
            self.noise = float(np.mean((y - lifted @ self.mean) ** 2))
        self.root = np.linalg.inv(np.linalg.cholesky(gram / self.noise + np.eye(len(gram)) / PRIOR))

    def reset(self, seed):
        """Nothing is random and nothing is remembered."""

    def predict(self, observation, step):
        """Action and variances for one observation (d,)."""
        lifted = self._lift(self._scaled(np.asarray(observation, float))[None])[0]
        action = np.clip(lifted @ self.mean, -1, 1)
        known = np.full(len(action), float(np.sum((self.root @ lifted) ** 2)))
        return Prediction(action, known, np.full(len(action), self.noise))

    def _scaled_by(self, observations):
        """Standardise; angles (the third number of the cart-pole) become sine and cosine."""
        encoded = self._encoded(observations)
        self.centre, self.width = encoded.mean(axis=0), encoded.std(axis=0)
        return (encoded - self.centre) / self.width

    def _scaled(self, observation):
        return (self._encoded(observation) - self.centre) / self.width

    @staticmethod
    def _encoded(observations):
        angle = observations[..., 2:3]
        return np.concatenate([observations[..., [0, 1, 3]], np.sin(angle), np.cos(angle)], axis=-1)

    def _lift(self, scaled):
        return np.sqrt(2 / FEATURES) * np.cos(scaled @ self.frequencies.T + self.phases)


def make(demonstrations, seed):
    """The factory: `safeswitch evaluate --learner numpy_learner:make`."""
    return FourierLearner(demonstrations, seed)
