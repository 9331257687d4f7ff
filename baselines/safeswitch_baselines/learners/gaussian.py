"""The heteroscedastic Gaussian that a network predicts (Kendall & Gal 2017, arXiv 1703.04977): loss and moments.

A network's output is split into the mean `mu` (nu,) and the log-variance `s = log sigma^2` (nu,) of the action, and
K dropout samples of it are one prediction:

    action        = mean_k mu_k
    epistemic_var = var_k mu_k            (population variance)
    aleatoric_var = mean_k sigma_k^2
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn


def bounded_log_var(raw: Tensor, bounds: tuple[float, float]) -> Tensor:
    """Log-variance within `bounds`, smooth and close to `raw` inside (Chua et al. 2018, arXiv 1805.12114, app. A.1)."""
    low, high = bounds
    below = high - nn.functional.softplus(high - raw)
    return low + nn.functional.softplus(below - low)


def bounded_variance(raw: NDArray[np.float64], bounds: tuple[float, float]) -> NDArray[np.float64]:
    """`exp(bounded_log_var(raw, bounds))` in numpy, for one decision; the two soft bounds have a closed form."""
    low, high = bounds
    return math.exp(low) + 1.0 / (math.exp(-high) + np.exp(-np.maximum(raw, -500.0)))  # -500: exp stays finite


def gaussian_nll(mean: Tensor, log_var: Tensor, target: Tensor, beta: float = 0.0) -> Tensor:
    """Heteroscedastic negative log-likelihood, per component (n, nu); constants left out.

    `0.5 exp(-s) (y - mu)^2 + 0.5 s`, times the detached `sigma^(2 beta)` (beta-NLL, Seitzer et al. 2022,
    arXiv 2203.09168). beta = 0 is the plain loss; beta = 1 trains the mean like the squared error.
    """
    loss = 0.5 * torch.exp(-log_var) * (target - mean) ** 2 + 0.5 * log_var
    return loss if beta == 0 else loss * torch.exp(beta * log_var).detach()


def moments(
    output: NDArray[np.float64], actions: int, bounds: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Mean action, epistemic and aleatoric variance, each (nu,), from raw network outputs (2 nu, K)."""
    samples = output.shape[1]
    mu, raw = output[:actions], output[actions:]
    action = np.add.reduce(mu, axis=1) / samples
    deviation = mu - action[:, None]
    epistemic_var = np.add.reduce(deviation * deviation, axis=1) / samples
    aleatoric_var = np.add.reduce(bounded_variance(raw, bounds), axis=1) / samples
    return action, epistemic_var, aleatoric_var
