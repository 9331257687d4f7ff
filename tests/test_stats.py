"""Laws of the intervals and tests."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binomtest

from safeswitch.scoring.stats import (
    bootstrap_mean,
    exact_mcnemar_p,
    holm,
    mcnemar,
    paired_difference,
    percentile_interval,
    resample_weights,
    weighted_means,
    wilson,
)
from safeswitch.seeding import stream


def crossed(learners: int, seeds: int) -> tuple[np.ndarray, np.ndarray]:
    learner, seed = np.meshgrid(np.arange(learners), np.arange(seeds), indexing="ij")
    return learner.ravel(), seed.ravel()


@pytest.mark.parametrize("confidence", [0.9, 0.95, 0.99])
def test_wilson_equals_scipy(confidence: float) -> None:
    cases = [(k, n) for n in (1, 7, 40, 400) for k in {0, 1, n // 3, n - 1, n}]
    lo, hi = wilson([k for k, _ in cases], [n for _, n in cases], confidence)
    for i, (k, n) in enumerate(cases):
        reference = binomtest(k, n).proportion_ci(confidence, method="wilson")
        assert lo[i] == pytest.approx(reference.low, abs=1e-12)
        assert hi[i] == pytest.approx(reference.high, abs=1e-12)


def test_wilson_reference_value_and_edges() -> None:
    # Newcombe, Statistics in Medicine 17 (1998) 857-872, table I, method 3: 81 of 263 and 0 of 20
    lo, hi = wilson([81, 0], [263, 20])
    assert np.round(lo, 4).tolist() == [0.2553, 0.0]
    assert np.round(hi, 4).tolist() == [0.3662, 0.1611]
    assert np.isnan(wilson(0, 0)).all()
    assert wilson(5, 5)[1] == 1.0
    with pytest.raises(ValueError, match="between 0"):
        wilson(6, 5)
    with pytest.raises(ValueError, match="confidence"):
        wilson(1, 5, 1.5)


def test_mcnemar_counts_and_exact_p() -> None:
    a = np.array([1, 1, 1, 1, 1, 1, 0, 0, 1])
    b = np.array([0, 0, 0, 0, 0, 1, 1, 0, 1])
    test = mcnemar(a, b)
    assert (test.only_a, test.only_b) == (5, 1)
    assert test.p == pytest.approx(2 * (1 + 6) / 2**6)  # P(X <= 1), X ~ Binomial(6, 1/2), twice
    assert mcnemar(b, a).p == test.p
    assert mcnemar(a, a).p == 1.0 == exact_mcnemar_p(0, 0)
    with pytest.raises(ValueError, match="one shape"):
        mcnemar(a, b[:3])


def test_holm_on_a_worked_example_and_its_laws() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]).tolist() == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert np.isnan(holm([0.01, np.nan])[1])
    assert holm([0.01, np.nan])[0] == 0.01
    p = stream(0, "p").random(30)
    adjusted = holm(p)
    assert np.all(adjusted >= p)
    assert np.all(adjusted <= np.minimum(30 * p, 1))
    assert np.all(np.diff(adjusted[np.argsort(p)]) >= 0)
    assert np.array_equal(holm(p[::-1]), adjusted[::-1])


def test_twins_and_learners_get_product_weights() -> None:
    learner, seed = crossed(4, 9)
    learner, seed = np.tile(learner, 2), np.tile(seed, 2)  # every episode with its twin
    weights = resample_weights(learner, seed, stream(0, "w"), 50)
    assert np.array_equal(weights[:, :36], weights[:, 36:])
    table = weights[:, :36].reshape(50, 4, 9)
    assert np.all(table.sum(axis=(1, 2)) == 36)
    by_learner, by_seed = table.sum(axis=2) / 9, table.sum(axis=1) / 4
    assert np.array_equal(table, by_learner[:, :, None] * by_seed[:, None, :])
    assert np.all(by_learner.sum(axis=1) == 4)


def test_opposite_twins_have_no_spread() -> None:
    learner, seed = crossed(3, 10)
    values = stream(1, "v").random(30)
    interval = bootstrap_mean(np.r_[values, 1 - values], np.tile(learner, 2), np.tile(seed, 2), stream(0, "b"))
    assert interval.lo == pytest.approx(0.5) == interval.hi


def test_draws_do_not_depend_on_the_order_of_the_observations() -> None:
    learner, seed = crossed(3, 8)
    order = stream(0, "o").permutation(24)
    weights = resample_weights(learner, seed, stream(0, "w"), 20)
    assert np.array_equal(resample_weights(learner[order], seed[order], stream(0, "w"), 20), weights[:, order])


def test_one_learner_is_not_resampled() -> None:
    weights = resample_weights(np.zeros(10, int), np.arange(10), stream(0, "w"), 200)
    assert np.all(weights.sum(axis=1) == 10)
    values = stream(2, "v").random(10)
    spread = weighted_means(weights, values).std()
    assert spread == pytest.approx(values.std() / np.sqrt(10), rel=0.15)


def test_paired_difference_is_exact_for_a_constant_gap_and_antisymmetric() -> None:
    learner, seed = crossed(5, 20)
    a = stream(3, "a").random(100)
    gap = paired_difference(a + 0.25, a, learner, seed, stream(0, "d"))
    assert (gap.estimate, gap.lo, gap.hi) == pytest.approx((0.25, 0.25, 0.25))
    b = stream(3, "b").random(100)
    forth = paired_difference(a, b, learner, seed, stream(0, "d"))
    back = paired_difference(b, a, learner, seed, stream(0, "d"))
    assert (back.lo, back.hi) == pytest.approx((-forth.hi, -forth.lo))


def test_percentile_interval_leaves_nan_out() -> None:
    samples = np.array([[0.0, np.nan], [1.0, np.nan], [np.nan, np.nan]])
    lo, hi = percentile_interval(samples)
    assert (lo[0], hi[0]) == pytest.approx((0.025, 0.975))
    assert np.isnan([lo[1], hi[1]]).all()


def simulate(rng: np.random.Generator, spread: tuple[float, float, float], learners: int, seeds: int) -> np.ndarray:
    """Crossed random effects: learner + seed + residual, standard deviations `spread`, mean 0."""
    effects = rng.normal(size=learners), rng.normal(size=seeds), rng.normal(size=(learners, seeds))
    return (spread[0] * effects[0][:, None] + spread[1] * effects[1] + spread[2] * effects[2]).ravel()


@pytest.mark.parametrize(
    ("spread", "learners", "least"),
    [((0.0, 1.0, 0.5), 5, 0.92), ((1.0, 1.0, 0.5), 12, 0.86), ((0.0, 0.0, 1.0), 5, 0.95)],
    ids=["hard seeds", "learners differ", "noise only"],
)
def test_coverage_of_the_bootstrap_on_crossed_effects(
    spread: tuple[float, float, float], learners: int, least: float
) -> None:
    rng, (learner, seed) = stream(4, "coverage"), crossed(learners, 40)
    covered = []
    for trial in range(300):
        interval = bootstrap_mean(simulate(rng, spread, learners, 40), learner, seed, stream(trial, "b"), 200)
        covered.append(interval.lo <= 0 <= interval.hi)
    assert np.mean(covered) >= least


def test_wider_than_independent_trials_when_learners_differ() -> None:
    learner, seed = crossed(5, 40)
    values = simulate(stream(5, "sim"), (1.0, 0.0, 1.0), 5, 40)
    pooled = bootstrap_mean(values, learner, seed, stream(0, "b"))
    naive = bootstrap_mean(values, np.zeros(200, int), np.arange(200), stream(0, "b"))
    assert pooled.hi - pooled.lo > 2 * (naive.hi - naive.lo)
