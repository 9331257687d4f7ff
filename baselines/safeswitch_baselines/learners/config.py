"""Settings that every Bayesian learner shares, and how settings are checked and kept as JSON."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from safeswitch.names import unknown

LOSSES = ("nll", "beta-nll")


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """How a network is trained and sampled. Plain JSON values; each learner adds its own fields and defaults.

    Attributes:
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
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, list):
                object.__setattr__(self, entry.name, tuple(value))
        self._check()

    def _check(self) -> None:
        low, high = self.log_var_bounds
        require(low < high, "log_var_bounds", self.log_var_bounds, "(low, high) with low < high")
        if self.loss not in LOSSES:
            raise unknown("loss", self.loss, LOSSES)
        require(0 <= self.beta <= 1, "beta", self.beta, "a number in [0, 1]")
        for name in ("samples", "epochs", "batch_size"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "a positive integer")
        require(self.learning_rate > 0, "learning_rate", self.learning_rate, "a positive number")
        for name in ("weight_decay", "max_gradient_norm", "warmup_epochs"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "a number >= 0")
        require(0 <= self.validation_fraction < 1, "validation_fraction", self.validation_fraction, "[0, 1)")

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values; `from_json` gives the same config back."""
        values = dataclasses.asdict(self)
        return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """Config from plain JSON values; unknown keys are errors that name the nearest one."""
        names = [entry.name for entry in dataclasses.fields(cls)]
        for key in values:
            if key not in names:
                raise unknown(f"{cls.__name__} field", key, names)
        return cls(**values)


def rates_of(name: str, value: float | tuple[float, ...], layers: int) -> tuple[float, ...]:
    """Dropout rate of each of `layers` layers from a setting that is one rate or one per layer."""
    rates = value if isinstance(value, tuple) else (float(value),) * layers
    require(len(rates) == layers, name, value, f"one rate or {layers} of them")
    require(all(0 <= rate < 1 for rate in rates), name, value, "rates in [0, 1)")
    return rates


def factors_of(name: str, value: int | tuple[int, ...], layers: int) -> tuple[int, ...]:
    """Factor of each of `layers` layers from a setting that is one integer or one per layer."""
    factors = value if isinstance(value, tuple) else (int(value),) * layers
    require(len(factors) == layers, name, value, f"one integer or {layers} of them")
    require(all(factor >= 1 for factor in factors), name, value, "positive integers; 1 leaves the size as it is")
    return factors


def require(condition: bool, name: str, value: object, allowed: str) -> None:
    """Raise the error that a setting's wrong value deserves."""
    if not condition:
        raise ValueError(f"{name}={value!r} is not allowed: {name} must be {allowed}")
