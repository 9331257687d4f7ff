"""SafeDAgger's safety classifier: Zhang and Cho 2017, arXiv 1605.06450.

    value = P(|a_learner - a_expert| > tau | trunk features)

a probability, from a network on the learner's trunk features, fitted to steps of the demonstrations whose labels are
the expert's actions. The source trains it on the data of the learner and on some kept apart from it; here these are
steps that the learner was trained on, all but one in twenty, with the masks of its dropout on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safeswitch.demos import Demonstrations
from safeswitch.protocols import Array, FeatureLearner, Prediction, TrainingFeatures
from safeswitch_baselines.signals.features import layers, perceptron, standardised, trunk_features, varying

TAU = 0.05
"""Deviation that counts as unsafe, in action units: the source's bound, 0.0025 on the squared deviation."""
EPISODES = 100
"""Demonstrations on which the learner is asked for its action, step by step."""


class Discrepancy:
    """Chance that the learner's action is further than `TAU` from the expert's [-].

    Args:
        arrays: `size`, `kept` (d,), `mean` (d,), `scale` (d,), and weights and biases of the classifier, by layer.
    """

    id = "discrepancy"
    clip = 5.0

    def __init__(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        self._size = int(arrays["size"])
        self._kept, self._mean, self._scale = arrays["kept"], arrays["mean"], arrays["scale"]
        self._classifier = layers(arrays, "classifier")

    @classmethod
    def fit(cls, training: TrainingFeatures, seed: int) -> dict[str, NDArray[Any]]:
        """Ask the learner on the first demonstrations, and learn where it is further than `TAU` from the labels."""
        from safeswitch_baselines.signals import fitting

        some = training.demonstrations.first(EPISODES)
        deviation = deviations(training.learner, some)
        kept = varying(training.features)
        features = training.features[: len(some), kept]
        mean = features.mean(axis=0, dtype=np.float64).astype(np.float32)
        scale = features.std(axis=0, dtype=np.float64).astype(np.float32)
        scale = np.where(scale > 0, scale, np.float32(1))
        inputs = standardised(features, mean, scale, cls.clip)
        return {
            "size": np.array(training.features.shape[1]),
            "kept": kept,
            "mean": mean,
            "scale": scale,
            **fitting.classify(inputs, deviation > TAU, seed),
        }

    def reset(self) -> None:
        """Nothing to forget."""

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        """Value at this step."""
        features = trunk_features(self.id, prediction, self._size)
        inputs = standardised(features[self._kept], self._mean, self._scale, self.clip)
        odds = float(perceptron(self._classifier, inputs)[0])
        return 1.0 / (1.0 + math.exp(-min(max(odds, -50.0), 50.0)))


def deviations(learner: FeatureLearner, demonstrations: Demonstrations) -> Array:
    """(n,) Euclidean distance of the learner's action from the label at every step [action units]."""
    found = []
    for episode in np.unique(demonstrations.episodes):
        learner.reset(int(episode))
        labels = demonstrations.actions[demonstrations.steps(int(episode))]
        for step, (observation, label) in enumerate(zip(demonstrations.episode(int(episode)), labels, strict=True)):
            found.append(math.dist(learner.predict(observation, step).action, label))
    return np.array(found)
