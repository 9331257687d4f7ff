"""Signals in action units: what the learner says about its own prediction, and what the other learners say.

epistemic = sqrt(sum_i epistemic_var_i)     the learner does not know
aleatoric = sqrt(sum_i aleatoric_var_i)     the labels are noisy there
total     = sqrt(sum_i (epistemic_var_i + aleatoric_var_i))
ensemble  = sqrt(sum_i var_m action_mi)     learners of other seeds would act differently
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from safeswitch.protocols import Array, Learner, Prediction


class Epistemic:
    """Standard deviation of the posterior samples' means [action units]."""

    id = "epistemic"

    def reset(self) -> None:
        """Nothing to forget."""

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        """Value at this step."""
        return math.sqrt(_sum(prediction.epistemic_var))


class Aleatoric:
    """Standard deviation of the predicted label noise [action units]."""

    id = "aleatoric"

    def reset(self) -> None:
        """Nothing to forget."""

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        """Value at this step."""
        return math.sqrt(_sum(prediction.aleatoric_var))


class Total:
    """Standard deviation of the prediction, both parts together [action units]: the paper's signal."""

    id = "total"

    def reset(self) -> None:
        """Nothing to forget."""

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        """Value at this step."""
        return math.sqrt(_sum(prediction.epistemic_var) + _sum(prediction.aleatoric_var))


def _sum(variances: Array) -> float:
    return float(np.add.reduce(variances))


class Ensemble:
    """Standard deviation of the mean actions of this learner and those of the other seeds [action units].

    Deep ensembles: Lakshminarayanan, Pritzel, Blundell 2017, arXiv 1612.01474. The members see every observation in
    order, as a memory of frames needs, and their randomness is keyed by (0, step) in every episode. A member that has
    a `mean_action(observation, step)` is asked for this alone, which spares it the samples of its posterior.

    Args:
        members: learners of the other seeds, at least one.
    """

    id = "ensemble"
    members: ClassVar[bool] = True
    """It is made from the learners of the other seeds."""

    def __init__(self, members: Sequence[Learner]) -> None:
        if not members:
            raise ValueError("signal 'ensemble' needs the learners of other seeds, got none: train at least two")
        self._others = tuple(members)
        self.reset()

    def reset(self) -> None:
        """Start an episode of every member."""
        self._step = 0
        for member in self._others:
            member.reset(0)

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        """Value at this step."""
        others = [_mean_action(member, observation, self._step) for member in self._others]
        self._step += 1
        components = np.array([prediction.action, *others], dtype=np.float64).T.tolist()
        return math.sqrt(math.fsum(_variance(values) for values in components))


def _mean_action(member: Learner, observation: NDArray[Any], step: int) -> Array:
    if hasattr(member, "mean_action"):
        action: Array = member.mean_action(observation, step)
        return action
    return member.predict(observation, step).action


def _variance(values: list[float]) -> float:
    """Population variance; fsum rounds once, so the order of the members does not matter."""
    mean = math.fsum(values) / len(values)
    return math.fsum((value - mean) ** 2 for value in values) / len(values)
