from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from safeswitch.demos import Demonstrations
from safeswitch_baselines.learners.bayesian import BayesianLearner
from safeswitch_baselines.learners.networks import MLPConfig
from safeswitch_baselines.learners.training import train_bayesian_mlp

QUICK = MLPConfig(hidden=(64, 64), epochs=5, batch_size=128)


def noise_std(x: np.ndarray) -> np.ndarray:
    return 0.05 + 0.2 * (x > 0)


def demonstrations(episodes: int = 40, length: int = 100, seed: int = 0) -> Demonstrations:
    """y = sin(2 x) + noise whose size depends on x, for x in [-1, 1]; a second component that says nothing."""
    rng = np.random.default_rng(seed)
    n = episodes * length
    observations = rng.uniform(-1, 1, (n, 2))
    x = observations[:, :1]
    labels = 0.8 * np.sin(2 * x) + noise_std(x) * rng.standard_normal((n, 1))
    return Demonstrations(observations.astype(np.float32), labels, np.repeat(np.arange(episodes), length))


def predictions(learner: BayesianLearner, xs: np.ndarray) -> np.ndarray:
    """Rows (action, epistemic std, aleatoric std) at x, the second component zero."""
    learner.reset(0)
    rows = [learner.predict(np.array([x, 0.0]), step) for step, x in enumerate(xs)]
    return np.array([[p.action[0], p.epistemic_var[0] ** 0.5, p.aleatoric_var[0] ** 0.5] for p in rows])


def weights(learner: BayesianLearner) -> bytes:
    return b"".join(parameter.detach().numpy().tobytes() for parameter in learner.model.parameters())


@pytest.fixture(scope="module", params=["nll", "beta-nll"])
def trained(request) -> BayesianLearner:
    # Little dropout: the variance that the masks themselves cause is part of the loss, hence of the learned noise.
    config = MLPConfig(hidden=(64, 64), dropout=0.02, epochs=40, batch_size=128, loss=request.param, warmup_epochs=2)
    return train_bayesian_mlp(demonstrations(), seed=1, config=config)


def test_mean_and_noise_are_recovered(trained):
    xs = np.linspace(-0.85, 0.85, 35)
    xs = xs[np.abs(xs) > 0.15]  # away from the jump of the noise
    action, _, aleatoric = predictions(trained, xs).T
    np.testing.assert_allclose(action, 0.8 * np.sin(2 * xs), atol=0.12)
    np.testing.assert_allclose(aleatoric, noise_std(xs), rtol=0.4)
    assert aleatoric[xs > 0].mean() > 3 * aleatoric[xs < 0].mean()


def test_epistemic_std_is_larger_away_from_the_data(trained):
    inside = predictions(trained, np.linspace(-0.8, 0.8, 40))[:, 1]
    outside = predictions(trained, np.concatenate([np.linspace(-5, -3, 20), np.linspace(3, 5, 20)]))[:, 1]
    assert np.median(outside) > 2 * np.median(inside)


def test_history_shows_that_it_learned(trained):
    assert set(trained.history) == {"loss", "learning_rate", "validation_nll", "validation_rmse"}
    assert all(len(values) == 40 for values in trained.history.values())
    noise = np.sqrt(np.mean(noise_std(np.linspace(-1, 1, 100)) ** 2))
    assert trained.history["validation_nll"][-1] < trained.history["validation_nll"][0] - 1.0
    assert trained.history["validation_rmse"][-1] == pytest.approx(noise, rel=0.15)
    assert trained.history["learning_rate"][-1] < 0.01 * max(trained.history["learning_rate"])


def test_same_seed_same_bits_whatever_the_threads():
    demos, threads = demonstrations(10), torch.get_num_threads()
    state, results = torch.get_rng_state(), []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            results.append(weights(train_bayesian_mlp(demos, 3, QUICK, device="cpu")))
            assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(threads)
    assert results[0] == results[1]
    assert torch.equal(torch.get_rng_state(), state), "torch's global generator was used"
    assert weights(train_bayesian_mlp(demos, 4, QUICK, device="cpu")) != results[0]


@pytest.mark.parametrize("loss", ["nll", "beta-nll"])
def test_noise_free_labels_do_not_break_the_loss(loss):
    demos = demonstrations(10)
    exact = dataclasses.replace(demos, actions=np.full_like(demos.actions, 0.25))
    learner = train_bayesian_mlp(exact, 0, dataclasses.replace(QUICK, epochs=60, loss=loss))
    assert np.isfinite(learner.history["loss"]).all()
    prediction = learner.predict(np.array([0.3, 0.0]), 0)
    assert prediction.aleatoric_var[0] >= np.exp(QUICK.log_var_bounds[0])
    assert abs(prediction.action[0] - 0.25) < 0.1


def test_progress_reports_every_epoch_and_validation_may_be_left_out():
    seen: list[tuple[int, int]] = []
    config = dataclasses.replace(QUICK, epochs=3, validation_fraction=0.0)
    learner = train_bayesian_mlp(demonstrations(5), 0, config, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert set(learner.history) == {"loss", "learning_rate"}


def test_a_learner_trains_from_plain_options():
    learner = BayesianLearner.train(demonstrations(5), 0, {"hidden": [16, 16], "epochs": 2})
    assert learner.config == MLPConfig(hidden=(16, 16), epochs=2)
    assert learner.observation_shape == (2,)


def test_several_actions_are_learned_apart():
    demos = demonstrations(10)
    both = dataclasses.replace(demos, actions=np.hstack([demos.actions, np.full_like(demos.actions, -0.5)]))
    prediction = train_bayesian_mlp(both, 0, dataclasses.replace(QUICK, epochs=60)).predict(np.array([0.5, 0.0]), 0)
    assert prediction.action.shape == (2,)
    assert abs(prediction.action[1] + 0.5) < 0.1 and prediction.aleatoric_var[1] < prediction.aleatoric_var[0]


def test_wrong_demonstrations_and_settings_are_refused():
    demos = demonstrations(3)
    with pytest.raises(ValueError, match=r"observations \(300, 2\), actions \(299, 1\)"):
        train_bayesian_mlp(dataclasses.replace(demos, actions=demos.actions[1:]), 0, QUICK)
    with pytest.raises(ValueError, match="not finite in actions"):
        train_bayesian_mlp(dataclasses.replace(demos, actions=demos.actions * np.nan), 0, QUICK)
    with pytest.raises(ValueError, match="no demonstrations"):
        empty = Demonstrations(demos.observations[:0], demos.actions[:0], demos.episodes[:0])
        train_bayesian_mlp(empty, 0, QUICK)
    with pytest.raises(ValueError, match="unknown device 'gpu'"):
        train_bayesian_mlp(demos, 0, QUICK, device="gpu")
