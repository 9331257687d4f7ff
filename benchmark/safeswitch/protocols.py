"""What the parts of the suite agree on: learner, signal, switch rule, method and expert, with shapes and units.

Anything that satisfies these protocols takes part; nothing has to inherit from them. `nu` is the number of
actions of a task, `nx` the size of its full state. Actions are in action units, [-1, 1] per component.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pathlib import Path

    from safeswitch.demos import Demonstrations
    from safeswitch.handover.panel import Calibration

Array = NDArray[np.float64]

Arming = Literal["onset", "start"]
"""When the monitor is switched on: at the onset step t0 (the paper), or at step 0 (as deployed)."""

ARMINGS: tuple[Arming, ...] = ("onset", "start")


class Driver(IntEnum):
    """Who chooses the action of a step."""

    LEARNER = 0
    EXPERT = 1


UNSAID: Array = np.full(1, np.nan)
"""A variance that a learner does not give: signals made from it are NaN, and rules on them are refused."""


@dataclass(frozen=True)
class Prediction:
    """What a learner says at one step. Only the action is required: `Prediction(action)`.

    Attributes:
        action: (nu,), action units.
        epistemic_var: (nu,), variance of the mean over the posterior samples, action units squared.
        aleatoric_var: (nu,), mean of the predicted noise variance, action units squared.
        features: optional (d,), trunk features for signals that are computed on them.
    """

    action: Array
    epistemic_var: Array = field(default_factory=lambda: UNSAID)
    aleatoric_var: Array = field(default_factory=lambda: UNSAID)
    features: NDArray[np.float32] | None = None


@runtime_checkable
class Learner(Protocol):
    """Maps an observation to a `Prediction`. May keep a memory (for example a frame stack), reset with the episode."""

    def reset(self, seed: int) -> None:
        """Start an episode. Any randomness of `predict` must be a function of (`seed`, step) alone."""

    def predict(self, observation: NDArray[Any], step: int) -> Prediction:
        """Predict the action of environment step `step` (0 .. T-1). Called once at every step, in order."""


@runtime_checkable
class LearnerFactory(Protocol):
    """What makes a learner: what an entry point of `safeswitch.learners` or `--learner package.module:factory` names.

    The least that takes part is a function, and a `Learner` that it returns. It may ask for `demonstrations` (to train)
    and `seed`, by these names, and must be a function of them:

        def make(demonstrations, seed): ...   # called in every process that needs the learner: right for seconds
        def make(): ...                       # ready-made, for example from a file of weights beside the module

    What takes longer to train is a class with the three methods below, which is trained once per learner seed and kept
    in the store as the files that `save` wrote. See docs/add_a_learner.md.
    """

    @classmethod
    def train(cls, demonstrations: Demonstrations, seed: int, options: Mapping[str, Any]) -> KeptLearner:
        """Train: a function of the arguments. `options` are the settings that the suite lists, empty for outsiders."""

    @classmethod
    def load(cls, folder: Path) -> KeptLearner:
        """The learner that `save` wrote; it predicts the same bits."""


@runtime_checkable
class KeptLearner(Learner, Protocol):
    """A learner that can be written to files."""

    def save(self, folder: Path) -> Any:
        """Write the learner into `folder`, which does not exist yet."""


@runtime_checkable
class FeatureLearner(Learner, Protocol):
    """A learner whose trunk features signals can be fitted to."""

    def features(self, demonstrations: Demonstrations) -> NDArray[np.float32]:
        """(n, d), what `Prediction.features` would be at each of the n training steps, in order."""


@runtime_checkable
class Signal(Protocol):
    """A scalar per step that should rise when the learner should not drive.

    What is registered as a signal is a factory, of one of three kinds:

    * without arguments, for a signal that reads the prediction alone;
    * fitted, with a class method `fit` (see `FittedSignal`): called with the arrays that `fit` made for this learner;
    * with a true attribute `members`: called with the learners of the other seeds. Their memory and randomness are
      their own: the signal resets them with the episode and lets them predict at every step.
    """

    id: str

    def reset(self) -> None:
        """Start an episode: forget any smoothing window or previous observation."""

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        """Value at this step. `previous_action` is the action executed at the step before, None at step 0."""


@runtime_checkable
class FittedSignal(Signal, Protocol):
    """A signal with something to learn from the training steps of its learner, once, before any episode."""

    @classmethod
    def fit(cls, training: TrainingFeatures, seed: int) -> dict[str, NDArray[Any]]:
        """Arrays by name, from which the signal is made: a function of the arguments to the last bit."""


@dataclass(frozen=True)
class TrainingFeatures:
    """What signals are fitted to; the features are computed once for all of them.

    Attributes:
        learner: the trained learner.
        demonstrations: what it was trained on, n steps.
    """

    learner: FeatureLearner
    demonstrations: Demonstrations

    @cached_property
    def features(self) -> NDArray[np.float32]:
        """(n, d), trunk features of every training step."""
        if not isinstance(self.learner, FeatureLearner):
            name = type(self.learner).__name__
            raise TypeError(f"{name} has no features(demonstrations): no signal can be fitted to its trunk features")
        features = self.learner.features(self.demonstrations)
        if features.ndim != 2 or len(features) != len(self.demonstrations):
            raise ValueError(f"features have shape {features.shape}, expected ({len(self.demonstrations)}, d)")
        return features

    @property
    def episodes(self) -> NDArray[np.int64]:
        """(n,), index of the episode that a step belongs to."""
        return self.demonstrations.episodes

    @property
    def executed(self) -> Array:
        """(n, nu), executed actions in action units; the labels where demonstrations do not keep them."""
        executed = self.demonstrations.executed
        return self.demonstrations.actions if executed is None else executed


@dataclass(frozen=True)
class SignalContext:
    """What the signals of one learner are made from.

    Attributes:
        fits: arrays that `FittedSignal.fit` made for this learner, by the id of the unsmoothed signal.
        members: learners of the other seeds.
        shared: unsmoothed signals made in this context so far, for their smoothed versions to read. Signals of one
            context are therefore updated together, in one episode at a time.
    """

    fits: Mapping[str, Mapping[str, NDArray[Any]]] = field(default_factory=dict)
    members: Sequence[Learner] = ()
    shared: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)


@runtime_checkable
class SwitchRule(Protocol):
    """Decides the driver of each step from the signals, and from nothing else.

    A class or function that makes one is enough for `--rule package.module:factory`. Three attributes are then looked
    at, with these defaults: `reads = ()`, ids of the signals that the rule looks at (in plain episodes the others are
    not computed); `latched = True`, whether it never gives control back; `needs = ()`, as in `Method`.
    """

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
        rule: the switch rule, ready to run; None where the method cannot have what it asks for in this cell (for
            example a share of expert steps): it is then left out there.
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
    "rollouts", "privileged". `latched` is False for a rule that may give control back. An optional `reads` lists
    the ids of signals that it looks at besides the one in its id.
    """

    id: str
    needs: frozenset[str]
    latched: bool

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Choose the free parameters from the calibrate split and return the rule to be tested."""
