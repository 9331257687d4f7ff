"""Bayesian multi-layer perceptron: Kendall & Gal 2017 (arXiv 1703.04977) on Gal & Ghahramani 2016 (arXiv 1506.02142).

A network of ReLU layers, each followed by dropout, whose output is split into the mean `mu` (nu,) and the log-variance
`s = log sigma^2` (nu,) of the action. Dropout stays on at test time: every mask is a sample of the posterior. Masks
are arguments (`dropout`), and not even the initialisation of the weights touches a global random generator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from safeswitch_baselines.learners.config import TrainingConfig, rates_of, require
from safeswitch_baselines.learners.dropout import MaskLayout
from safeswitch_baselines.learners.gaussian import bounded_log_var


@dataclass(frozen=True, kw_only=True)
class MLPConfig(TrainingConfig):
    """Everything that decides a trained Bayesian MLP, besides its data and its seed. Plain JSON values.

    Attributes:
        hidden: width of each hidden layer.
        dropout: chance to drop a unit, after every hidden layer, or one value per hidden layer (0: no dropout there).
        last_dropout: the same after the last hidden layer, whatever `dropout` says; None for no exception. Dropout
            there alone leaves the expected mean as it is, since the output is linear in that layer.
        angles: indices of observation components in [rad] that the network sees as (sin, cos).
    """

    hidden: tuple[int, ...] = (256, 256, 256)
    dropout: float | tuple[float, ...] = 0.1
    last_dropout: float | None = None
    angles: tuple[int, ...] = ()

    def _check(self) -> None:
        require(len(self.hidden) > 0 and min(self.hidden) > 0, "hidden", self.hidden, "one or more positive widths")
        rates_of("dropout", self.dropout, len(self.hidden))
        rates_of("last_dropout", self.last_dropout or 0.0, 1)
        require(all(index >= 0 for index in self.angles), "angles", self.angles, "non-negative indices")
        require(len(set(self.angles)) == len(self.angles), "angles", self.angles, "indices without repetition")
        super()._check()

    @property
    def rates(self) -> tuple[float, ...]:
        """Dropout rate of every hidden layer."""
        rates = rates_of("dropout", self.dropout, len(self.hidden))
        return rates if self.last_dropout is None else (*rates[:-1], self.last_dropout)

    @property
    def layout(self) -> MaskLayout:
        """Layout of the masks of the hidden layers."""
        return MaskLayout.of(self.hidden, self.rates)


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

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """Mean and scale."""
        return {"mean": self.mean, "scale": self.scale}

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
