"""What fitted signals learn from training features: covariances, axes, regressions, classifiers, distillation.

Everything runs on one torch thread, in double precision where matrices are factorised, in memory that torch aligned:
the same arguments give the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from safeswitch.protocols import Array
from safeswitch.seeding import stream
from safeswitch_baselines.learners.dropout import one_thread

Floats = NDArray[np.float32]

WIDTHS = (128, 64)
"""Hidden and output width of the random target; the predictor has one more hidden layer, as the paper's has."""
BATCH, UPDATES, RATE = 256, 500, 1e-3
"""How networks are trained; a fixed number of updates, whatever the number of training steps."""
CLASSIFIER, DECAY = 64, 1e-2
"""Hidden units and weight decay of a classifier on features."""


@dataclass(frozen=True)
class Normal:
    """Mean (d,), covariance (d, d), and the weight in [0, 1] of the identity in that covariance."""

    mean: Array
    covariance: Array
    shrinkage: float


def ledoit_wolf(samples: NDArray[Any]) -> Normal:
    """Mean and well-conditioned covariance of `samples` (n, d): Ledoit and Wolf 2004, J. Multivariate Analysis 88.

        Sigma = delta m I + (1 - delta) S,   m = tr(S) / d,   delta = min(b^2, c^2) / c^2
        c^2 = |S - m I|^2,   b^2 = (mean_k |x_k|^4 - |S|^2) / n     (x centred, |.| Frobenius)

    The common factor 1 / d of the paper's norms cancels in delta.
    """
    with one_thread():
        x = torch.tensor(samples, dtype=torch.float64)
        count, size = x.shape
        mean = x.mean(dim=0)
        x -= mean
        covariance = x.T @ x / count
        level = covariance.trace().item() / size
        target = level * torch.eye(size, dtype=torch.float64)
        spread = (covariance - target).square().sum().item()
        error = (x.square().sum(dim=1).square().mean() - covariance.square().sum()).item() / count
        # Never quite zero, so that the inverse exists; without any spread all weights give the same matrix.
        delta = min(max(error / spread, 1e-9), 1.0) if spread > 0 else 1.0
        shrunk = delta * target + (1.0 - delta) * covariance
        return Normal(mean.numpy(), shrunk.numpy(), delta)


def whitening(covariance: Array) -> Array:
    """W (d, d), lower triangular, with W' W the inverse of a positive definite covariance."""
    with one_thread():
        factor = torch.linalg.cholesky(torch.tensor(covariance, dtype=torch.float64))
        inverse = torch.linalg.solve_triangular(factor, torch.eye(len(covariance), dtype=torch.float64), upper=False)
        return inverse.contiguous().numpy()


def principal_axes(samples: NDArray[Any], count: int, smallest: float = 1e-6) -> tuple[Floats, Floats]:
    """Mean (d,) and at most `count` principal axes (k, d), scaled so that the samples have unit variance on each.

    Axes with less than `smallest` times the first one's variance are left out.
    """
    with one_thread():
        x = torch.tensor(samples, dtype=torch.float64)
        mean = x.mean(dim=0)
        x -= mean
        variances, vectors = torch.linalg.eigh(x.T @ x / len(x))
        variances, vectors = variances.flip(0)[:count], vectors.flip(1)[:, :count]
        if not variances[0] > 0:
            raise ValueError(f"all {x.shape[1]} trunk features are constant over {len(x)} training steps")
        kept = variances > smallest * variances[0]
        axes = (vectors[:, kept] / variances[kept].sqrt()).T
        return mean.numpy().astype(np.float32), np.ascontiguousarray(axes.numpy(), dtype=np.float32)


def project(samples: NDArray[Any], mean: Floats, axes: Floats) -> Floats:
    """Coordinates (n, k) of `samples` (n, d) on principal axes."""
    with one_thread():
        centred = torch.tensor(samples, dtype=torch.float64) - torch.tensor(mean, dtype=torch.float64)
        return (centred @ torch.tensor(axes, dtype=torch.float64).T).numpy().astype(np.float32)


def ridge(inputs: NDArray[Any], outputs: NDArray[Any], strength: float) -> tuple[Floats, Array]:
    """Ridge regression of `outputs` (n, k) on `inputs` (n, m).

    Args:
        inputs: regressors of order one, a constant among them.
        outputs: what to predict.
        strength: weight of the squared coefficients, per sample.

    Returns:
        Coefficients (k, m) and residuals (n, k).
    """
    with one_thread():
        x, y = (torch.tensor(values, dtype=torch.float64) for values in (inputs, outputs))
        gram = x.T @ x / len(x) + strength * torch.eye(x.shape[1], dtype=torch.float64)
        solution = torch.cholesky_solve(x.T @ y / len(x), torch.linalg.cholesky(gram))
        return np.ascontiguousarray(solution.T.numpy(), dtype=np.float32), (y - x @ solution).numpy()


def distil(inputs: Floats, seed: int) -> dict[str, Floats]:
    """A random target network, a predictor trained to imitate it on `inputs` (n, d), and its mean squared error.

    Args:
        inputs: standardised features.
        seed: draws both networks and the order of the samples.
    """
    hidden, output = WIDTHS
    with one_thread():
        x = torch.tensor(inputs, dtype=torch.float32)
        target = _perceptron((x.shape[1], hidden, output), seed, "rnd-target")
        predictor = _perceptron((x.shape[1], hidden, hidden, output), seed, "rnd-predictor")
        with torch.inference_mode():
            wanted = target(x)
        _train(predictor, x, wanted.clone(), _mean_square, seed, "rnd-order")
        with torch.inference_mode():
            level = (predictor(x) - wanted).square().mean()
    return {"level": level.numpy(), **_arrays(target, "target"), **_arrays(predictor, "predictor")}


def classify(inputs: Floats, labels: NDArray[np.bool_], seed: int) -> dict[str, Floats]:
    """A network with `CLASSIFIER` rectified units whose output is the log-odds of `labels` (n,) given `inputs` (n, d).

    Args:
        inputs: standardised features.
        labels: what to predict; cross-entropy.
        seed: draws the network and the order of the samples.
    """
    with one_thread():
        x, y = torch.tensor(inputs, dtype=torch.float32), torch.tensor(labels, dtype=torch.float32)[:, None]
        network = _perceptron((x.shape[1], CLASSIFIER, 1), seed, "classifier")
        _train(network, x, y, torch.nn.functional.binary_cross_entropy_with_logits, seed, "classifier-order", DECAY)
    return _arrays(network, "classifier")


def _perceptron(widths: tuple[int, ...], seed: int, name: str) -> nn.Sequential:
    """Rectified network with He-normal weights; the last layer's keep the variance of its inputs."""
    rng = stream(seed, name)
    layers: list[nn.Module] = []
    for index, (fan_in, fan_out) in enumerate(zip(widths[:-1], widths[1:], strict=True)):
        last = index == len(widths) - 2
        layer = nn.utils.skip_init(nn.Linear, fan_in, fan_out)
        weight = rng.standard_normal((fan_out, fan_in)) * math.sqrt((1.0 if last else 2.0) / fan_in)
        with torch.no_grad():
            layer.weight.copy_(torch.from_numpy(weight))
            layer.bias.zero_()
        layers += [layer] if last else [layer, nn.ReLU()]
    return nn.Sequential(*layers)


def _train(
    network: nn.Sequential,
    inputs: Tensor,
    wanted: Tensor,
    loss_of: Callable[[Tensor, Tensor], Tensor],
    seed: int,
    order_name: str,
    decay: float = 0.0,
) -> None:
    """Train in place: Adam, with decoupled weight decay, and a rate that falls to zero along a cosine."""
    rng = stream(seed, order_name)
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, UPDATES)
    epochs = math.ceil(UPDATES * BATCH / len(inputs))
    order = torch.from_numpy(np.concatenate([rng.permutation(len(inputs)) for _ in range(epochs)]))
    for chosen in order[: UPDATES * BATCH].split(BATCH):
        loss = loss_of(network(inputs[chosen]), wanted[chosen])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()


def _mean_square(output: Tensor, wanted: Tensor) -> Tensor:
    return (output - wanted).square().mean()


def _arrays(network: nn.Sequential, name: str) -> dict[str, Floats]:
    """Weights and biases by layer."""
    linears = [layer for layer in network if isinstance(layer, nn.Linear)]
    return {
        f"{name}-{part}{index}": tensor.detach().numpy().copy()
        for index, layer in enumerate(linears)
        for part, tensor in (("weight", layer.weight), ("bias", layer.bias))
    }
