"""What the parts of the suite agree on: learner, signal, switch rule, method and expert, with shapes and units.

Anything that satisfies these protocols takes part; nothing has to inherit from them. `nu` is the number of
actions of a task, `nx` the size of its full state. Actions are in action units, [-1, 1] per component.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from safeswitch.handover.panel import Calibration

Array = NDArray[np.float64]

Arming = Literal["onset", "start"]
"""When the monitor is switched on: at the onset step t0 (the paper), or at step 0 (as deployed)."""

ARMINGS: tuple[Arming, ...] = ("onset", "start")


class Driver(IntEnum):
    """Who chooses the action of a step."""

    LEARNER = 0
    EXPERT = 1


@dataclass(frozen=True)
class Prediction:
    """What a learner says at one step.

    Attributes:
        action: (nu,), action units.
        epistemic_var: (nu,), variance of the mean over the posterior samples, action units squared.
        aleatoric_var: (nu,), mean of the predicted noise variance, action units squared.
        features: optional (d,), trunk features for signals that are computed on them.
    """

    action: Array
    epistemic_var: Array
    aleatoric_var: Array
    features: NDArray[np.float32] | None = None


@runtime_checkable
class Learner(Protocol):
    """Maps an observation to a `Prediction`. May keep a memory (for example a frame stack), reset with the episode."""

    def reset(self, seed: int) -> None:
        """Start an episode. Any randomness of `predict` must be a function of (`seed`, step) alone."""

    def predict(self, observation: NDArray[Any], step: int) -> Prediction:
        """Predict the action of environment step `step` (0 .. T-1). Called once at every step, in order."""


@runtime_checkable
class Signal(Protocol):
    """A scalar per step that should rise when the learner should not drive."""

    id: str

    def reset(self) -> None:
        """Start an episode: forget any smoothing window or previous observation."""

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        """Value at this step. `previous_action` is the action executed at the step before, None at step 0."""


@runtime_checkable
class SwitchRule(Protocol):
    """Decides the driver of each step from the signals, and from nothing else."""

    def reset(self, seed: int) -> None:
        """Start an episode."""

    def arm(self, step: int) -> Driver:
        """The monitor is switched on at `step`: the driver of that very step (LEARNER for nearly every rule)."""

    def update(self, step: int, signals: Mapping[str, float]) -> Driver:
        """The driver of step `step + 1`, from the signals of the armed step `step`."""


@runtime_checkable
class Expert(Protocol):
    """Model-predictive controller that knows the full state and the current model parameters."""

    def reset(self) -> None:
        """Forget the plan: the next action comes from a cold start, a function of the state alone."""

    def action(self, state: Array, parameters: Array) -> Array:
        """Action (nu,) in action units for the full state (nx,) under the model parameters (np,), SI units."""


@dataclass(frozen=True)
class Calibrated:
    """A method after calibration in one (learner, cell, arming).

    Attributes:
        rule: the switch rule, ready to run.
        threshold: its threshold in the signal's units; NaN where it has none.
        tuning_episodes: episodes spent on calibration (candidates x episodes for searches).
        expert_queries: expert-driven steps spent on calibration.
        log: arrays worth keeping, such as every CEM sample (name -> array).
    """

    rule: Any
    threshold: float = float("nan")
    tuning_episodes: int = 0
    expert_queries: int = 0
    log: Mapping[str, NDArray[Any]] = field(default_factory=dict)


@runtime_checkable
class Method(Protocol):
    """Signal x calibrator x return rule, found by its id (`rule@signal`, or `rule` alone).

    `needs` lists what calibration or decision requires beyond the learner: any of "expert-queries", "failures",
    "rollouts", "privileged". `latched` is False for a rule that may give control back.
    """

    id: str
    needs: frozenset[str]
    latched: bool

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Choose the free parameters from the calibrate split and return the rule to be tested."""
