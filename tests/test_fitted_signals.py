"""Signals beyond the paper: the laws behind them, on learners whose features are known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from safeswitch import registry
from safeswitch.demos import Demonstrations
from safeswitch.files import load_arrays, save_arrays
from safeswitch.protocols import FittedSignal, Prediction, Signal, SignalContext, TrainingFeatures
from safeswitch_baselines.signals import KNN, RND, Discrepancy, DynamicsResidual, Mahalanobis, fitting, make_signal
from safeswitch_baselines.signals.discrepancy import EPISODES, TAU

OBSERVATION, ZERO = np.zeros(4), np.zeros(1)
NOVELTY = (Mahalanobis, KNN, RND, DynamicsResidual)
FITTED = (*NOVELTY, Discrepancy)


@dataclass
class Known:
    """A learner whose trunk features are the observations."""

    def reset(self, seed: int) -> None:
        pass

    def predict(self, observation: Any, step: int) -> Prediction:
        return Prediction(ZERO, ZERO, ZERO, np.asarray(observation, np.float32))

    def features(self, demonstrations: Demonstrations) -> Any:
        return demonstrations.observations.astype(np.float32)


def training(features: Any, actions: Any = None, length: int = 50) -> TrainingFeatures:
    """Training steps in episodes of `length` steps."""
    count = len(features)
    actions = np.zeros((count, 1)) if actions is None else actions
    return TrainingFeatures(Known(), Demonstrations(features, actions, np.arange(count) // length))


def value(signal: Signal, features: Any, action: Any = None) -> float:
    return signal.update(OBSERVATION, Prediction(ZERO, ZERO, ZERO, np.asarray(features, np.float32)), action)


def values(signal: Signal, features: Any) -> Any:
    signal.reset()
    return np.array([value(signal, each) for each in features])


def correlated(count: int, size: int = 6, seed: int = 0) -> tuple[Any, Any, Any]:
    """Gaussian samples (count, size), their mean and covariance."""
    rng = np.random.default_rng(seed)
    root, mean = rng.standard_normal((size, size)), rng.standard_normal(size)
    return rng.standard_normal((count, size)) @ root.T + mean, mean, root @ root.T


def curve(count: int, seed: int = 0, size: int = 20) -> Any:
    """Points near a closed curve in `size` dimensions, as features of a periodic motion are."""
    rng = np.random.default_rng(seed)
    angle = 0.2 * np.arange(count) + 0.01 * rng.standard_normal(count)
    basis = np.random.default_rng(99).standard_normal((6, size))
    waves = np.stack([wave(k * angle) for k in (1, 2, 3) for wave in (np.sin, np.cos)], axis=1)
    return waves @ basis + 0.02 * rng.standard_normal((count, size))


# --- Ledoit and Wolf ---


def test_shrinkage_of_a_small_case_by_hand() -> None:
    # Four points, S = diag(2, 1/2), m = 5/4: |S - m I|^2 = 9/8, and mean |x|^4 = (16 + 1) / 2 = 17/2, |S|^2 = 17/4,
    # so b^2 = (17/2 - 17/4) / 4 = 17/16 and delta = (17/16) / (9/8) = 17/18.
    normal = fitting.ledoit_wolf(np.array([[2.0, 0.0], [-2.0, 0.0], [0.0, 1.0], [0.0, -1.0]]) + [3.0, -7.0])
    assert normal.shrinkage == pytest.approx(17 / 18)
    np.testing.assert_allclose(normal.mean, [3.0, -7.0])
    np.testing.assert_allclose(normal.covariance, 17 / 18 * 1.25 * np.eye(2) + 1 / 18 * np.diag([2.0, 0.5]))


def test_shrinkage_vanishes_with_many_samples_and_the_covariance_is_consistent() -> None:
    shrinkage = []
    for count in (50, 500, 50_000):
        samples, _, covariance = correlated(count)
        shrinkage.append(fitting.ledoit_wolf(samples).shrinkage)
    assert shrinkage[0] > 5 * shrinkage[1] > 25 * shrinkage[2] and shrinkage[2] < 1e-3
    np.testing.assert_allclose(fitting.ledoit_wolf(samples).covariance, covariance, atol=0.03 * covariance.max())


def test_with_fewer_samples_than_dimensions_the_covariance_is_well_conditioned_and_closer_to_the_truth() -> None:
    samples = np.random.default_rng(0).standard_normal((20, 60)) * np.linspace(0.5, 1.5, 60)
    truth, raw = np.diag(np.linspace(0.5, 1.5, 60) ** 2), np.cov(samples.T, bias=True)
    normal = fitting.ledoit_wolf(samples)
    assert np.linalg.cond(normal.covariance) < 50 and np.linalg.matrix_rank(raw) < 20
    assert np.linalg.norm(normal.covariance - truth) < 0.5 * np.linalg.norm(raw - truth)
    assert np.trace(normal.covariance) == pytest.approx(np.trace(raw))


def test_whitening_inverts_the_covariance() -> None:
    _, _, covariance = correlated(1)
    W = fitting.whitening(covariance)
    np.testing.assert_allclose(W.T @ W @ covariance, np.eye(len(covariance)), atol=1e-9)


# --- Mahalanobis ---


def test_mahalanobis_is_the_textbook_distance() -> None:
    samples, mean, covariance = correlated(40_000)
    signal = Mahalanobis(Mahalanobis.fit(training(samples), 0))
    fresh = np.random.default_rng(1).multivariate_normal(mean, covariance, 2_000)
    apart = fresh - mean
    textbook = np.einsum("ni,ij,nj->n", apart, np.linalg.inv(covariance), apart)
    np.testing.assert_allclose(values(signal, fresh), textbook / 6, rtol=0.1)
    assert np.mean(values(signal, fresh)) == pytest.approx(1, rel=0.05)


def test_mahalanobis_does_not_depend_on_rotation_scale_or_origin() -> None:
    samples, _, _ = correlated(40)  # few, so that the covariance is much shrunk
    rotation = np.linalg.qr(np.random.default_rng(5).standard_normal((6, 6)))[0]
    plain = Mahalanobis(Mahalanobis.fit(training(samples), 0))
    moved = Mahalanobis(Mahalanobis.fit(training(3.0 * samples @ rotation - 5.0), 0))
    np.testing.assert_allclose(values(plain, samples), values(moved, 3.0 * samples @ rotation - 5.0), rtol=1e-4)


def test_units_that_never_fire_are_left_out() -> None:
    samples, _, _ = correlated(500)
    wide = np.concatenate([np.zeros((500, 2)), samples, np.full((500, 1), 0.7)], axis=1)
    for each in (Mahalanobis, RND):
        signal = each(each.fit(training(wide), 0))
        found = values(signal, wide[:20])
        assert np.isfinite(found).all()
        unseen = wide[:20] + np.eye(9)[0]
        np.testing.assert_array_equal(values(signal, unseen), found)
    with pytest.raises(ValueError, match="all 3 trunk features are constant over 100 training steps"):
        Mahalanobis.fit(training(np.ones((100, 3))), 0)


# --- distances, distillation, dynamics ---


def test_knn_is_the_distance_to_the_tenth_neighbour_on_whitened_axes() -> None:
    samples, _, _ = correlated(300)
    arrays = KNN.fit(training(samples), 0)
    whitened = (samples - samples.mean(axis=0)) @ arrays["axes"].T.astype(float)
    np.testing.assert_allclose(whitened.T @ whitened / 300, np.eye(6), atol=1e-4)
    signal = KNN(arrays)
    for index, found in enumerate(values(signal, samples[:30])):
        assert found == pytest.approx(
            np.sort(np.linalg.norm(whitened - whitened[index], axis=1))[9] / np.sqrt(6), rel=1e-3
        )


def test_knn_keeps_a_random_part_of_many_training_features() -> None:
    samples, _, _ = correlated(6_000)
    one, other = (KNN.fit(training(samples), seed)["reference"] for seed in (0, 1))
    assert one.shape == (5_000, 6) and not np.array_equal(one, other)


@pytest.mark.parametrize("signal", NOVELTY)
def test_features_off_the_training_set_stand_out(signal: Any) -> None:
    made = signal(signal.fit(training(curve(2_000)), 0))
    near, far = curve(100, seed=1), np.random.default_rng(2).permuted(curve(100, seed=1), axis=1)
    if signal is DynamicsResidual:  # which asks how one step follows from the other
        on, off = ([value(made, each, ZERO) for each in points][1:] for points in (near, far))
    else:
        on, off = values(made, near), values(made, far)
    assert np.min(off) > np.max(on)


def test_the_distilled_network_is_learned_and_not_copied() -> None:
    samples = curve(2_000)
    arrays = RND.fit(training(samples), 0)
    trained = np.mean(values(RND(arrays), samples[:100]))
    target = {name.replace("target", "predictor"): each for name, each in arrays.items() if "target" in name}
    copied = {name: each for name, each in arrays.items() if "predictor" not in name} | target
    zero = {name: np.zeros_like(each) if "predictor" in name else each for name, each in arrays.items()}
    assert np.max(values(RND(copied), samples[:100])) == 0.0
    assert 0 < trained < 0.3 * np.mean(values(RND(zero), samples[:100]))
    assert np.mean(values(RND(arrays), samples)) == pytest.approx(1, rel=0.02)


def linear_system(A: Any, B: Any, count: int, seed: int) -> tuple[Any, Any]:
    """States (count, 3) in episodes of 50 steps, and executed actions (count, 1)."""
    rng = np.random.default_rng(seed)
    states, actions = np.empty((count, 3)), rng.uniform(-1, 1, (count, 1))
    for step in range(count):
        start = step % 50 == 0
        x = 0.3 * rng.standard_normal(3) if start else A @ states[step - 1] + B @ actions[step - 1]
        states[step] = x + 0.01 * rng.standard_normal(3)
    return states, actions


A = np.array([[0.9, 0.2, 0.0], [-0.2, 0.9, 0.1], [0.0, -0.1, 0.8]])
B = np.array([[0.0], [0.1], [0.3]])
READOUT = np.random.default_rng(7).standard_normal((3, 12))


def residuals(signal: Signal, states: Any, actions: Any) -> Any:
    """(episodes, 50) values over whole episodes."""
    rows = []
    for start in range(0, len(states), 50):
        signal.reset()
        steps = range(start, start + 50)
        rows.append([value(signal, states[t] @ READOUT, None if t == start else actions[t - 1]) for t in steps])
    return np.array(rows)


def test_the_residual_of_the_dynamics_grows_when_they_change() -> None:
    states, actions = linear_system(A, B, 5_000, 0)
    signal = DynamicsResidual(DynamicsResidual.fit(training(states @ READOUT, actions), 0))
    nominal = residuals(signal, *linear_system(A, B, 2_500, 1))
    assert (nominal[:, 0] == 0.0).all() and (nominal[:, 1:] > 0).all()
    assert np.mean(nominal[:, 1:]) == pytest.approx(1, rel=0.2), "whitened residuals"
    drifted = [residuals(signal, *linear_system(A, factor * B, 500, 1))[:, 1:].mean() for factor in (1.0, 1.5, 3.0)]
    assert 1.5 * drifted[0] < drifted[1] < 0.6 * drifted[2]
    turned = residuals(signal, *linear_system(A.T, B, 500, 1))
    assert turned[:, 1:].mean() > 3 * nominal[:, 1:].mean() and (turned[:, 0] == 0.0).all()


def test_the_residual_uses_the_executed_action() -> None:
    states, actions = linear_system(A, B, 5_000, 0)
    demonstrations = Demonstrations(states @ READOUT, np.zeros_like(actions), np.arange(5_000) // 50)
    object.__setattr__(demonstrations, "executed", actions)
    told = DynamicsResidual(DynamicsResidual.fit(TrainingFeatures(Known(), demonstrations), 0))
    plain = DynamicsResidual(DynamicsResidual.fit(training(states @ READOUT, actions), 0))
    test = linear_system(A, B, 200, 2)
    np.testing.assert_array_equal(residuals(told, *test), residuals(plain, *test))
    wrong = residuals(plain, test[0], -test[1])
    assert wrong[:, 1:].mean() > 3 * residuals(plain, *test)[:, 1:].mean()


def test_dynamics_are_learned_within_episodes_alone() -> None:
    with pytest.raises(ValueError, match="at least two steps an episode"):
        DynamicsResidual.fit(training(curve(60), length=1), 0)
    states, actions = linear_system(A, B, 1_000, 0)
    half = np.concatenate([np.arange(0, 1_000, 50), np.arange(49, 1_000, 50)])  # the ends of the episodes
    moved = training(states @ READOUT, actions)
    same = DynamicsResidual.fit(moved, 0)
    actions = actions.copy()
    actions[np.sort(half)[1::2]] = 9.0  # the last action of an episode leads nowhere
    np.testing.assert_array_equal(same["model"], DynamicsResidual.fit(training(states @ READOUT, actions), 0)["model"])


# --- discrepancy ---


class Erring(Known):
    """Its action is 0; the labels of the demonstrations differ from it where the first feature is positive."""


def erring(count: int, seed: int) -> tuple[Any, Any]:
    features, _, _ = correlated(count, seed=seed)
    return features, np.where(features[:, :1] > 0, 2 * TAU, 0.5 * TAU)


def test_discrepancy_is_the_chance_that_the_learner_deviates() -> None:
    features, labels = erring(6_000, 0)
    demonstrations = training(features, labels).demonstrations
    signal = Discrepancy(Discrepancy.fit(TrainingFeatures(Erring(), demonstrations), 0))
    fresh, labels = erring(1_000, 1)
    p, unsafe = values(signal, fresh), labels[:, 0] > TAU
    assert ((p >= 0) & (p <= 1)).all() and np.mean((p > 0.5) == unsafe) > 0.9
    assert np.mean(p) == pytest.approx(np.mean(unsafe), abs=0.05), "probabilities add up"


def test_discrepancy_asks_the_learner_on_the_first_demonstrations_in_order() -> None:
    class Asked(Known):
        def __init__(self) -> None:
            self.calls: list[tuple[int, int]] = []

        def reset(self, seed: int) -> None:
            self.episode = seed

        def predict(self, observation: Any, step: int) -> Prediction:
            self.calls.append((self.episode, step))
            return super().predict(observation, step)

    features, labels = erring(5 * (EPISODES + 20), 2)
    learner = Asked()
    Discrepancy.fit(TrainingFeatures(learner, training(features, labels, length=5).demonstrations), 0)
    assert learner.calls == [(episode, step) for episode in range(EPISODES) for step in range(5)]


# --- all of them ---


@pytest.mark.parametrize("signal", FITTED)
def test_fits_are_the_same_bits_for_the_same_seed_whatever_the_threads(signal: Any, tmp_path: Path) -> None:
    threads = torch.get_num_threads()
    features = training(curve(1_500))
    found = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            found.append(signal.fit(features, 3))
    finally:
        torch.set_num_threads(threads)
    one, other = found
    save_arrays(tmp_path / "fit.npz", **one)
    loaded = load_arrays(tmp_path / "fit.npz")
    assert set(one) == set(other) == set(loaded)
    for name, array in one.items():
        np.testing.assert_array_equal(array, other[name])
        np.testing.assert_array_equal(array, loaded[name])
    fresh = curve(50, seed=4)
    np.testing.assert_array_equal(values(signal(one), fresh), values(signal(loaded), fresh))
    assert all(np.asarray(array).dtype != object for array in one.values())


@pytest.mark.parametrize("signal", [KNN, RND, DynamicsResidual, Discrepancy])
def test_the_seed_draws_what_is_random(signal: Any) -> None:
    features = training(curve(5_200))
    one, other = signal.fit(features, 0), signal.fit(features, 1)
    assert any(not np.array_equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("signal", FITTED)
def test_fitted_signals_say_what_is_wrong_with_the_features(signal: Any) -> None:
    made = signal(signal.fit(training(curve(200)), 0))
    assert isinstance(made, FittedSignal) and registry.is_fitted(signal) and not registry.has_members(signal)
    with pytest.raises(ValueError, match=f"signal '{signal.id}' needs Prediction.features"):
        made.update(OBSERVATION, Prediction(ZERO, ZERO, ZERO), None)
    with pytest.raises(ValueError, match=rf"signal '{signal.id}' was fitted to features of shape \(20,\), got \(4,\)"):
        value(made, np.zeros(4))


def test_training_features_are_computed_once_and_checked() -> None:
    class Counting(Known):
        calls = 0

        def features(self, demonstrations: Demonstrations) -> Any:
            self.calls += 1
            return super().features(demonstrations)

    class Without:
        reset, predict = Known.reset, Known.predict

    demonstrations = training(curve(60)).demonstrations
    learner = Counting()
    shared = TrainingFeatures(learner, demonstrations)
    assert shared.features is shared.features and learner.calls == 1
    with pytest.raises(TypeError, match=r"Without has no features\(demonstrations\)"):
        _ = TrainingFeatures(Without(), demonstrations).features  # type: ignore[arg-type]


def test_smoothing_of_a_fitted_signal_over_two_episodes() -> None:
    fits = {"dynamics-residual": DynamicsResidual.fit(training(curve(400)), 0)}
    context = SignalContext(fits=fits)
    raw, smooth = (make_signal(name, context) for name in ("dynamics-residual", "dynamics-residual-mean3"))
    assert smooth.id == "dynamics-residual-mean3"
    for seed in (1, 2):
        raw.reset()
        smooth.reset()
        pairs = np.array([[value(smooth, each, ZERO), value(raw, each, ZERO)] for each in curve(10, seed=seed)])
        assert pairs[0, 1] == 0.0
        expected = [pairs[max(0, step - 2) : step + 1, 1].mean() for step in range(10)]
        np.testing.assert_allclose(pairs[:, 0], expected, rtol=1e-12)
