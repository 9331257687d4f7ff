"""Novelty of the trunk features: how far they are from those of the training steps, by three measures.

    mahalanobis   (f - mu)' Sigma^-1 (f - mu) / d                 Lee et al. 2018, arXiv 1807.03888
    knn           distance to the 10th-nearest training feature   Sun et al. 2022, arXiv 2204.06507
    rnd           error of a network distilled from another       Burda et al. 2018, arXiv 1810.12894

They have no unit and are of the order of 1 at the training steps, so that rules which search for a threshold need not
know the size of a network.
Each is fitted once to a learner (`fit`, which needs torch) and then made from the fitted arrays; a step costs one or
two products of a matrix and a vector. These are summed by `einsum` and not by BLAS, whose rounding may depend on the
number of threads: an episode must give the same bits in every process.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safeswitch.protocols import Array, Prediction, TrainingFeatures
from safeswitch.seeding import stream

Arrays = Mapping[str, NDArray[Any]]
Floats = NDArray[np.float32]


def trunk_features(signal: str, prediction: Prediction, size: int) -> Floats:
    """The features (`size`,) of a prediction; an error that names `signal` where there are none or others."""
    features = prediction.features
    if features is None:
        raise ValueError(f"signal {signal!r} needs Prediction.features, which this learner does not give")
    if features.shape != (size,):
        raise ValueError(f"signal {signal!r} was fitted to features of shape {(size,)}, got {features.shape}")
    return features


def product(matrix: Floats, vector: Floats) -> Floats:
    """`matrix @ vector` with the same bits for any number of threads."""
    return np.einsum("ij,j->i", matrix, vector)


def norm(vector: Floats) -> float:
    """Euclidean norm, summed in double precision."""
    wide = vector.astype(np.float64)
    return math.sqrt(float(np.einsum("i,i->", wide, wide)))


def varying(features: Floats) -> NDArray[np.int64]:
    """Indices of the columns that are not constant (units that never fired in training say nothing about scale)."""
    kept = np.flatnonzero(np.ptp(features, axis=0) > 0)
    if not len(kept):
        raise ValueError(f"all {features.shape[1]} trunk features are constant over {len(features)} training steps")
    return kept


class Mahalanobis:
    """Squared Mahalanobis distance to the training features, with Ledoit and Wolf's shrunk covariance, over d [-].

    Its mean over the training features is 1, up to the shrinkage; d is the number of features that vary.

    Args:
        arrays: `kept` (d,), indices of those features, `mean` (d,), `whitening` (d, d), W' W = Sigma^-1, and `size`.
    """

    id = "mahalanobis"

    def __init__(self, arrays: Arrays) -> None:
        self._size = int(arrays["size"])
        self._kept, self._mean, self._whitening = arrays["kept"], arrays["mean"], arrays["whitening"]

    @classmethod
    def fit(cls, training: TrainingFeatures, seed: int) -> dict[str, NDArray[Any]]:
        """Mean and shrunk covariance of the training features; nothing is drawn."""
        from safeswitch_baselines.signals import fitting

        kept = varying(training.features)
        normal = fitting.ledoit_wolf(training.features[:, kept])
        return {
            "size": np.array(training.features.shape[1]),
            "kept": kept,
            "mean": normal.mean.astype(np.float32),
            "whitening": fitting.whitening(normal.covariance).astype(np.float32),
        }

    def reset(self) -> None:
        """Nothing to forget."""

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        """Value at this step."""
        features = trunk_features(self.id, prediction, self._size)
        return norm(product(self._whitening, features[self._kept] - self._mean)) ** 2 / len(self._kept)


class KNN:
    """Distance to the 10th-nearest of 5,000 training features on their first 32 whitened principal axes [-].

    In units of the root mean square distance of the training features from their mean.

    Args:
        arrays: `mean` (d,), `axes` (k, d) and `reference` (m, k).
    """

    id = "knn"
    axes, references, neighbour = 32, 5000, 10

    def __init__(self, arrays: Arrays) -> None:
        self._mean, self._axes, self._reference = arrays["mean"], arrays["axes"], arrays["reference"]

    @classmethod
    def fit(cls, training: TrainingFeatures, seed: int) -> dict[str, NDArray[Any]]:
        """Principal axes, and the training features that are kept to compare with; `seed` draws these."""
        from safeswitch_baselines.signals import fitting

        features = training.features
        mean, axes = fitting.principal_axes(features, cls.axes)
        count = min(cls.references, len(features))
        chosen = np.sort(stream(seed, "knn-references").choice(len(features), count, replace=False))
        return {"mean": mean, "axes": axes, "reference": fitting.project(features[chosen], mean, axes)}

    def reset(self) -> None:
        """Nothing to forget."""

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        """Value at this step."""
        features = trunk_features(self.id, prediction, len(self._mean))
        apart = self._reference - product(self._axes, features - self._mean)
        squares = np.einsum("ij,ij->i", apart, apart)
        last = min(self.neighbour, len(squares)) - 1
        return math.sqrt(float(np.partition(squares, last)[last]) / len(self._axes))


class RND:
    """Random network distillation: squared error of a network trained to imitate a fixed random one [-].

    It is divided by the mean of this error over the training steps.

    Both read the training features standardised and, as in the paper, clipped to five standard deviations.

    Args:
        arrays: `size`, `kept` (d,), `mean` (d,), `scale` (d,), `level`, the mean squared error over the training steps,
            and weights and biases of both networks, by layer.
    """

    id = "rnd"
    clip = 5.0

    def __init__(self, arrays: Arrays) -> None:
        self._size = int(arrays["size"])
        self._kept, self._mean, self._scale = arrays["kept"], arrays["mean"], arrays["scale"]
        self._level = float(arrays["level"])
        self._target, self._predictor = layers(arrays, "target"), layers(arrays, "predictor")

    @classmethod
    def fit(cls, training: TrainingFeatures, seed: int) -> dict[str, NDArray[Any]]:
        """Draw the target, and the predictor's initial weights and batches, from `seed`; train the predictor."""
        from safeswitch_baselines.signals import fitting

        kept = varying(training.features)
        mean = training.features.mean(axis=0, dtype=np.float64)[kept].astype(np.float32)
        scale = training.features.std(axis=0, dtype=np.float64)[kept].astype(np.float32)
        inputs = standardised(training.features[:, kept], mean, scale, cls.clip)
        return {
            "size": np.array(training.features.shape[1]),
            "kept": kept,
            "mean": mean,
            "scale": scale,
            **fitting.distil(inputs, seed),
        }

    def reset(self) -> None:
        """Nothing to forget."""

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        """Value at this step."""
        features = trunk_features(self.id, prediction, self._size)
        inputs = standardised(features[self._kept], self._mean, self._scale, self.clip)
        error = perceptron(self._target, inputs) - perceptron(self._predictor, inputs)
        return norm(error) ** 2 / (len(error) * self._level)


def standardised(features: Floats, mean: Floats, scale: Floats, clip: float) -> Floats:
    """Features in standard deviations from their mean, cut off at `clip` of them."""
    return np.clip((features - mean) / scale, -clip, clip).astype(np.float32, copy=False)


def layers(arrays: Arrays, network: str) -> list[tuple[Floats, Floats]]:
    """Weights (out, in) and biases (out,) of a network, first layer first."""
    count = sum(name.startswith(f"{network}-weight") for name in arrays)
    return [(arrays[f"{network}-weight{index}"], arrays[f"{network}-bias{index}"]) for index in range(count)]


def perceptron(layers: list[tuple[Floats, Floats]], inputs: Floats) -> Floats:
    """Outputs of a network with rectified hidden layers."""
    *hidden, (weight, bias) = layers
    for inner, offset in hidden:
        inputs = np.maximum(product(inner, inputs) + offset, 0)
    return product(weight, inputs) + bias
