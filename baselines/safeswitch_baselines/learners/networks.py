"""Bayesian multi-layer perceptron: Kendall & Gal 2017 (arXiv 1703.04977) on Gal & Ghahramani 2016 (arXiv 1506.02142).

A network of ReLU layers, each followed by dropout, whose output is split into the mean `mu` (nu,) and the log-variance
`s = log sigma^2` (nu,) of the action. Dropout stays on at test time: every mask is a sample of the posterior.

Masks are arguments, never drawn inside: training draws them from its own generator, a decision from one keyed by
(episode seed, step). No global random generator is touched, not even by the initialisation of the weights.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from safeswitch.names import unknown

LOSSES = ("nll", "beta-nll")


@dataclass(frozen=True)
class MLPConfig:
    """Everything that decides a trained Bayesian MLP, besides its data and its seed. Plain JSON values.

    Attributes:
        hidden: width of each hidden layer.
        dropout: chance to drop a unit, after every hidden layer, or one value per hidden layer (0: no dropout there).
        angles: indices of observation components in [rad] that the network sees as (sin, cos).
        samples: K, number of dropout samples of a decision.
        log_var_bounds: soft bounds of `s`; they keep the loss finite where the labels are free of noise.
        loss: "nll", or "beta-nll" (Seitzer et al. 2022).
        beta: exponent of "beta-nll"; 0 is the plain negative log-likelihood.
        warmup_epochs: first epochs trained on the squared error of the mean alone.
        epochs: passes over the training samples.
        batch_size: samples of a gradient step.
        learning_rate: peak of the cosine schedule of AdamW.
        weight_decay: of AdamW, on the weights and not on the biases.
        max_gradient_norm: gradients are clipped to this norm; 0 for no clipping.
        validation_fraction: share of the *episodes* kept out for validation; 0 for none.
    """

    hidden: tuple[int, ...] = (256, 256, 256)
    dropout: float | tuple[float, ...] = 0.1
    angles: tuple[int, ...] = ()
    samples: int = 30
    log_var_bounds: tuple[float, float] = (-10.0, 5.0)
    loss: str = "nll"
    beta: float = 0.5
    warmup_epochs: int = 0
    epochs: int = 100
    batch_size: int = 512
    learning_rate: float = 2e-3
    weight_decay: float = 1e-4
    max_gradient_norm: float = 1.0
    validation_fraction: float = 0.05

    def __post_init__(self) -> None:
        """Turn JSON lists into tuples and reject values that cannot work."""
        for name in ("hidden", "angles", "log_var_bounds"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if not isinstance(self.dropout, (int, float)):
            object.__setattr__(self, "dropout", tuple(self.dropout))
        self._check()

    def _check(self) -> None:
        _require(len(self.hidden) > 0 and min(self.hidden) > 0, "hidden", self.hidden, "one or more positive widths")
        rates = self.rates
        _require(len(rates) == len(self.hidden), "dropout", self.dropout, f"one rate or {len(self.hidden)} of them")
        _require(all(0 <= rate < 1 for rate in rates), "dropout", self.dropout, "rates in [0, 1)")
        _require(all(index >= 0 for index in self.angles), "angles", self.angles, "non-negative indices")
        _require(len(set(self.angles)) == len(self.angles), "angles", self.angles, "indices without repetition")
        low, high = self.log_var_bounds
        _require(low < high, "log_var_bounds", self.log_var_bounds, "(low, high) with low < high")
        if self.loss not in LOSSES:
            raise unknown("loss", self.loss, LOSSES)
        _require(0 <= self.beta <= 1, "beta", self.beta, "a number in [0, 1]")
        for name in ("samples", "epochs", "batch_size"):
            _require(getattr(self, name) >= 1, name, getattr(self, name), "a positive integer")
        _require(self.learning_rate > 0, "learning_rate", self.learning_rate, "a positive number")
        for name in ("weight_decay", "max_gradient_norm", "warmup_epochs"):
            _require(getattr(self, name) >= 0, name, getattr(self, name), "a number >= 0")
        _require(0 <= self.validation_fraction < 1, "validation_fraction", self.validation_fraction, "[0, 1)")

    @property
    def rates(self) -> tuple[float, ...]:
        """Dropout rate of every hidden layer."""
        if isinstance(self.dropout, tuple):
            return self.dropout
        return (float(self.dropout),) * len(self.hidden)

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values; `from_json` gives the same config back."""
        values = dataclasses.asdict(self)
        return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> MLPConfig:
        """Config from plain JSON values; unknown keys are errors that name the nearest one."""
        names = [entry.name for entry in dataclasses.fields(cls)]
        for key in values:
            if key not in names:
                raise unknown("MLPConfig field", key, names)
        return cls(**values)


@dataclass(frozen=True)
class InputEncoding:
    """Observation (n, d) -> network input (n, e): angles become (sin, cos), then everything is standardised.

    Attributes:
        observation_shape: shape of one observation, (d,).
        angles: indices of components in [rad].
        mean: (e,), mean of the encoded training observations.
        scale: (e,), their standard deviation; 1 where a component never changes.
    """

    observation_shape: tuple[int, ...]
    angles: tuple[int, ...]
    mean: NDArray[np.float64]
    scale: NDArray[np.float64]
    _angle_index: NDArray[np.intp] = field(init=False, repr=False, compare=False)
    _other_index: NDArray[np.intp] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Index arrays, made once because every decision needs them."""
        others = [index for index in range(self.observation_shape[0]) if index not in self.angles]
        object.__setattr__(self, "_angle_index", np.array(self.angles, dtype=np.intp))
        object.__setattr__(self, "_other_index", np.array(others, dtype=np.intp))

    @classmethod
    def fit(cls, observations: NDArray[Any], angles: Sequence[int]) -> InputEncoding:
        """Standardisation of the training observations (n, d)."""
        if observations.ndim != 2:
            raise ValueError(f"a Bayesian MLP takes observations of shape (n, d); got {observations.shape}")
        size = observations.shape[1]
        if any(index >= size for index in angles):
            raise ValueError(f"angles={tuple(angles)} must be indices of an observation of {size} components")
        plain = cls((size,), tuple(angles), np.zeros(1), np.ones(1))(observations)
        deviation = plain.std(axis=0)
        # A constant component carries nothing: dividing by its rounding noise would only amplify it.
        scale = np.where(deviation > 1e-6, deviation, 1.0)
        return cls((size,), tuple(angles), plain.mean(axis=0), scale)

    @property
    def size(self) -> int:
        """Number of network inputs, e."""
        return len(self.mean)

    def __call__(self, observations: NDArray[Any]) -> NDArray[np.float64]:
        """Encode observations (n, d) as (n, e), float64: other components in their order, then sines, then cosines."""
        raw = np.asarray(observations, dtype=np.float64)
        if self.angles:
            theta = raw[:, self._angle_index]
            raw = np.concatenate([raw[:, self._other_index], np.sin(theta), np.cos(theta)], axis=1)
        return (raw - self.mean) / self.scale


class BayesianMLP(nn.Module):
    """ReLU layers with dropout after each, and one linear output split into mean and log-variance.

    Args:
        inputs: number of network inputs, e.
        actions: number of actions, nu.
        config: widths, dropout rates and bounds of the log-variance.
        generator: source of the initial weights (Kaiming uniform for the layers, small ones for the output).
    """

    def __init__(self, inputs: int, actions: int, config: MLPConfig, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.actions, self.rates, self.bounds = actions, config.rates, config.log_var_bounds
        widths = (inputs, *config.hidden)
        # `skip_init`: a plain nn.Linear would draw its weights from the global generator.
        self.layers = nn.ModuleList(
            nn.utils.skip_init(nn.Linear, a, b) for a, b in zip(widths[:-1], widths[1:], strict=True)
        )
        self.output = nn.utils.skip_init(nn.Linear, widths[-1], 2 * actions)
        for layer in self.linears():
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
            nn.init.zeros_(layer.bias)
        with torch.no_grad():
            self.output.weight.mul_(0.1)  # first predictions near 0, first variances near 1

    def linears(self) -> list[nn.Linear]:
        """The hidden layers and the output layer, in order."""
        return [layer for layer in (*self.layers, self.output) if isinstance(layer, nn.Linear)]

    def forward(self, inputs: Tensor, masks: Sequence[Tensor | None] | None = None) -> tuple[Tensor, Tensor]:
        """Mean and log-variance, each (n, nu), for network inputs (n, e).

        `masks` has one entry (n, width) per hidden layer: 0 for a dropped unit, 1 / (1 - rate) for a kept one; None
        keeps all. Without masks the network is deterministic (weight scaling).
        """
        hidden = inputs
        for index, layer in enumerate(self.layers):
            hidden = torch.relu(layer(hidden))
            mask = masks[index] if masks is not None else None
            if mask is not None:
                hidden = hidden * mask
        mean, raw = self.output(hidden).split(self.actions, dim=1)
        return mean, bounded_log_var(raw, self.bounds)


@dataclass(frozen=True)
class MaskLayout:
    """Where the dropout units of the layers lie in one block of random numbers (rows, units).

    A unit is kept when a uniform 16-bit number is at least rate * 65536, so a rate is met to 1 / 65536.

    Attributes:
        columns: the block's columns of each hidden layer; None for a layer without dropout.
        limits: (units,), smallest number that keeps each unit.
    """

    columns: tuple[slice | None, ...]
    limits: NDArray[np.uint16]

    @classmethod
    def of(cls, config: MLPConfig) -> MaskLayout:
        """Layout of the hidden layers of `config`."""
        used = [width if rate > 0 else 0 for width, rate in zip(config.hidden, config.rates, strict=True)]
        limits = np.repeat([round(rate * 65536) for rate in config.rates], used).astype(np.uint16)
        columns = tuple(slice(int(a), int(b)) if b > a else None for a, b in pairwise(np.cumsum([0, *used])))
        return cls(columns, limits)

    def words(self, rows: int) -> int:
        """64-bit words that `rows` rows take from a bit generator."""
        return -(-rows * len(self.limits) // 4)

    def draw(self, bits: np.random.BitGenerator, rows: int) -> list[NDArray[np.bool_] | None]:
        """Independent masks, one (rows, width) per hidden layer; True keeps the unit."""
        numbers = bits.random_raw(self.words(rows)).view(np.uint16)[: rows * len(self.limits)]
        keep = numbers.reshape(rows, len(self.limits)) >= self.limits
        return [None if columns is None else keep[:, columns] for columns in self.columns]


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


def _require(condition: bool, name: str, value: object, allowed: str) -> None:
    if not condition:
        raise ValueError(f"{name}={value!r} is not allowed: {name} must be {allowed}")
