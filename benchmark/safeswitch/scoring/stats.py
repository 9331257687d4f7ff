"""Intervals and tests: Wilson and exact McNemar within one learner, a crossed bootstrap over several.

Five learners tested on the same episode seeds are not 5 x 40 independent trials: a hard seed is hard for all of them,
and a poor learner is poor on all seeds. The bootstrap therefore draws learners and episode seeds, each with replacement
and independently of one another, and an observation of learner l and seed s counts (times l was drawn) x (times s was
drawn) times. This is the bootstrap of crossed random effects: Owen, "The pigeonhole bootstrap", Annals of Applied
Statistics 1(2), 2007, https://arxiv.org/abs/0712.1111. It is never too narrow for large samples, and it counts the
residual noise up to three times, so it errs on the wide side when learners and seeds hardly differ. A disturbed episode
and its undisturbed twin have the same learner and seed, hence the same weight in every resample.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binomtest, norm

from safeswitch.protocols import Array

CONFIDENCE = 0.95
RESAMPLES = 1000


@dataclass(frozen=True)
class Interval:
    """An estimate with a two-sided confidence interval, all in the unit of the score."""

    estimate: float
    lo: float
    hi: float


@dataclass(frozen=True)
class McNemar:
    """Paired comparison of two yes/no outcomes a and b.

    Attributes:
        only_a: pairs in which a succeeds and b fails.
        only_b: pairs in which b succeeds and a fails.
        p: two-sided exact p-value of "both are equally likely".
    """

    only_a: int
    only_b: int
    p: float


def wilson(successes: ArrayLike, trials: ArrayLike, confidence: float = CONFIDENCE) -> tuple[Array, Array]:
    """Wilson score interval of a proportion, vectorised (Wilson 1927).

    Args:
        successes: (...,) counts.
        trials: (...,) counts, the same shape or broadcastable; 0 trials give NaN.
        confidence: coverage, in (0, 1).

    Returns:
        Lower and upper bound, (...,), in [0, 1]; the bound is exactly 0 or 1 when no or all trials succeed.
    """
    k, n = np.broadcast_arrays(np.asarray(successes, float), np.asarray(trials, float))
    if np.any((k < 0) | (k > n)):
        raise ValueError("successes must lie between 0 and the number of trials")
    z = float(norm.ppf(0.5 + _checked(confidence) / 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = (k + z**2 / 2) / (n + z**2)
        half = z / (n + z**2) * np.sqrt(k * (n - k) / n + z**2 / 4)
    lo, hi = np.where(k == 0, 0.0, centre - half), np.where(k == n, 1.0, centre + half)
    return np.where(n > 0, lo, np.nan), np.where(n > 0, hi, np.nan)


def mcnemar(a: ArrayLike, b: ArrayLike) -> McNemar:
    """Exact McNemar test of two paired yes/no outcomes, each (n,): a binomial test on the pairs that differ."""
    first, second = np.asarray(a, bool), np.asarray(b, bool)
    if first.shape != second.shape:
        raise ValueError(f"paired outcomes must have one shape, got {first.shape} and {second.shape}")
    only_a, only_b = int(np.sum(first & ~second)), int(np.sum(~first & second))
    return McNemar(only_a, only_b, exact_mcnemar_p(only_a, only_b))


@lru_cache(maxsize=100_000)
def exact_mcnemar_p(only_a: int, only_b: int) -> float:
    """Two-sided exact p-value for `only_a` against `only_b` discordant pairs; 1 if there are none."""
    if only_a + only_b == 0:
        return 1.0
    return float(binomtest(only_a, only_a + only_b, 0.5).pvalue)


def holm(p_values: ArrayLike) -> Array:
    """Holm's step-down adjusted p-values (n,) of one family, in the order given; NaN entries are not counted."""
    p = np.asarray(p_values, float)
    adjusted = np.full(p.shape, np.nan)
    tested = np.flatnonzero(~np.isnan(p))
    order = tested[np.argsort(p[tested], kind="stable")]
    factors = np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * factors), 1.0)
    return adjusted


def resample_weights(
    learner: NDArray[Any], seed: NDArray[Any], rng: np.random.Generator, resamples: int = RESAMPLES
) -> Array:
    """How often each observation occurs in each resample of learners x episode seeds.

    Args:
        learner: (n,) learner of each observation.
        seed: (n,) episode seed of each observation; a twin has the seed of its disturbed episode.
        rng: generator of the draws. They depend on the distinct learners and seeds only.
        resamples: B.

    Returns:
        (B, n), whole numbers as float64, so that weighted sums of whole numbers are exact in any order.
    """
    if resamples < 1:
        raise ValueError(f"resamples must be at least 1, got {resamples}")
    by_learner = _multiplicities(learner, rng, resamples)
    by_seed = _multiplicities(seed, rng, resamples)
    return by_learner * by_seed


def _multiplicities(group: NDArray[Any], rng: np.random.Generator, resamples: int) -> Array:
    names, index = np.unique(np.asarray(group), return_inverse=True)
    count = len(names)
    if count == 1:  # a single learner is not resampled: the statement is about this one
        return np.ones((resamples, len(index)))
    drawn = rng.integers(count, size=(resamples, count))
    offset = np.arange(resamples)[:, None] * count
    counts = np.bincount((drawn + offset).ravel(), minlength=resamples * count).reshape(resamples, count)
    return counts.astype(np.float64)[:, index]


def weighted_means(weights: Array, values: ArrayLike) -> Array:
    """Mean of the values under each resample: (B, n) weights and (n, ...) values give (B, ...)."""
    values = np.asarray(values, float)
    total = weights.sum(axis=1).reshape((-1,) + (1,) * (values.ndim - 1))
    with np.errstate(invalid="ignore"):  # 0/0 in a resample without any observation (sparse designs): NaN, left out
        return np.tensordot(weights, values, axes=1) / total


def percentile_interval(samples: Array, confidence: float = CONFIDENCE) -> tuple[Array, Array]:
    """Percentile interval of (B, ...) bootstrap samples, each (...,); NaN samples are left out, NaN if all are."""
    tail = (1 - _checked(confidence)) / 2
    samples = np.asarray(samples, float)
    empty = np.isnan(samples).all(axis=0)
    filled = np.where(empty, 0.0, samples)
    lo, hi = np.nanquantile(filled, [tail, 1 - tail], axis=0)
    return np.where(empty, np.nan, lo), np.where(empty, np.nan, hi)


def bootstrap_mean(
    values: ArrayLike,
    learner: NDArray[Any],
    seed: NDArray[Any],
    rng: np.random.Generator,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
) -> Interval:
    """Mean of (n,) values with its interval over learners x episode seeds."""
    values = np.asarray(values, float)
    samples = weighted_means(resample_weights(learner, seed, rng, resamples), values)
    lo, hi = percentile_interval(samples, confidence)
    return Interval(float(values.mean()), float(lo), float(hi))


def paired_difference(
    a: ArrayLike,
    b: ArrayLike,
    learner: NDArray[Any],
    seed: NDArray[Any],
    rng: np.random.Generator,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
) -> Interval:
    """Mean of a - b, with a and b (n,) measured on the same episodes, and its interval."""
    first, second = np.asarray(a, float), np.asarray(b, float)
    if first.shape != second.shape:
        raise ValueError(f"paired values must have one shape, got {first.shape} and {second.shape}")
    return bootstrap_mean(first - second, learner, seed, rng, resamples, confidence)


def _checked(confidence: float) -> float:
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must lie in (0, 1), got {confidence}")
    return confidence
