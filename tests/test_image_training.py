"""Training from images: every sample once per epoch whatever the pools, the same bits, and something learned."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from safeswitch.demos import Demonstrations
from safeswitch_baselines.learners.bayesian import BayesianLearner
from safeswitch_baselines.learners.image import DropoutVGGLearner, PaperLiteralLearner
from safeswitch_baselines.learners.image_training import epochs_of, train_dropout_vgg
from safeswitch_baselines.learners.vgg import VGGConfig

SMALL = {"channels": (8, 8), "strides": (2, 1), "pools": (1, 2), "hidden": (32, 16)}
QUICK = VGGConfig.from_json({**SMALL, "epochs": 2, "batch_size": 16, "validation_fraction": 0.2})


def demonstrations(episodes: int = 6, length: int = 20, size: int = 16, seed: int = 0) -> Demonstrations:
    """A bright bar that moves to and fro; the label is its velocity, which no single frame shows."""
    rng = np.random.default_rng(seed)
    frames = rng.integers(0, 40, (episodes * length, size, size, 3), np.uint8)
    labels = np.empty((episodes * length, 1))
    for episode in range(episodes):
        position, velocity = rng.integers(2, size - 2), rng.choice([-1, 1])
        for step in range(length):
            if not 0 < position + velocity < size - 1:
                velocity = -velocity
            # The first step shows no motion, whatever the memory: it is at rest.
            position += velocity if step else 0
            frames[episode * length + step, :, position] = 220
            labels[episode * length + step] = 0.5 * velocity if step else 0.0
    return Demonstrations(frames, labels, np.repeat(np.arange(episodes), length))


def weights(trained) -> bytes:
    return b"".join(value.detach().numpy().tobytes() for value in trained[0].parameters())


@pytest.mark.parametrize("pool_episodes", [1, 4, 5, 100])
def test_every_sample_is_seen_exactly_once_per_epoch(pool_episodes):
    demos = demonstrations(episodes=9)
    n = len(demos)
    named = dataclasses.replace(demos, actions=np.arange(n, dtype=float)[:, None])  # a label names its sample
    config = dataclasses.replace(QUICK, pool_episodes=pool_episodes, epochs=3)
    orders = []
    for batches in epochs_of(named, np.arange(9), 0, config):
        seen = []
        for pool, rows in batches:
            assert len(torch.unique(pool.stacks)) <= pool_episodes * 20, "more was decoded than a pool holds"
            assert 1 <= len(rows) <= config.batch_size
            for row in rows:
                step = int(pool.labels[row])
                newest = pool.frames[pool.stacks[row, -1]].permute(1, 2, 0)
                np.testing.assert_array_equal(newest, named.observations[step])
                seen.append(step)
        assert sorted(seen) == list(range(n))
        orders.append(seen)
    assert orders[0] != orders[1] != orders[2], "the order is the same in every epoch"


def test_same_seed_same_bits_whatever_the_threads():
    demos, threads = demonstrations(), torch.get_num_threads()
    config = dataclasses.replace(QUICK, pool_episodes=2, trunk_dropout=0.1)
    state, results = torch.get_rng_state(), []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            results.append(weights(train_dropout_vgg(demos, 3, config, device="cpu")))
            assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(threads)
    assert results[0] == results[1]
    assert torch.equal(torch.get_rng_state(), state), "torch's global generator was used"
    assert weights(train_dropout_vgg(demos, 4, config, device="cpu")) != results[0]


def errors(learner: DropoutVGGLearner, demos: Demonstrations) -> float:
    """Mean absolute error of the actions along the first four episodes."""
    actions = []
    for episode in range(4):
        learner.reset(episode)
        actions.extend(learner.predict(frame, step).action for step, frame in enumerate(demos.episode(episode)))
    return float(np.abs(np.stack(actions) - demos.actions[: len(actions)]).mean())


def test_velocity_is_learned_from_the_memory_and_cannot_be_without_it():
    options = {**SMALL, "epochs": 25, "batch_size": 16, "learning_rate": 5e-3, "loss": "nll", "pixel_floor": 0.5}
    options |= {"feature_dropout": 0.0, "hidden_dropout": 0.0, "validation_fraction": 0.0}
    demos, fresh = demonstrations(episodes=16, seed=1), demonstrations(episodes=4, seed=5)
    three, one = (DropoutVGGLearner.train(demos, 0, {**options, "frames": frames}) for frames in (3, 1))
    assert errors(three, demos) < 0.03 and errors(three, fresh) < 0.05
    assert errors(one, fresh) > 0.3  # the labels are +-0.5


def test_it_overfits_a_small_set():
    demos = demonstrations(episodes=4)
    options = {**SMALL, "epochs": 60, "batch_size": 16, "learning_rate": 5e-3, "validation_fraction": 0.0}
    learner = DropoutVGGLearner.train(demos, 0, {**options, "feature_dropout": 0.0, "hidden_dropout": 0.0})
    assert errors(learner, demos) < 0.03


def test_history_and_progress_report_every_epoch():
    seen: list[tuple[int, int]] = []
    report = lambda done, total: seen.append((done, total))  # noqa: E731
    model, _, history = train_dropout_vgg(demonstrations(), 0, QUICK, report)
    assert seen == [(1, 2), (2, 2)] and not model.training
    assert {name: len(values) for name, values in history.items()} == dict.fromkeys(
        ("loss", "learning_rate", "validation_nll", "validation_rmse"), 2
    )
    _, _, history = train_dropout_vgg(demonstrations(), 0, dataclasses.replace(QUICK, validation_fraction=0.0))
    assert set(history) == {"loss", "learning_rate"}


def test_held_out_episodes_are_not_in_the_pixel_statistics():
    demos = demonstrations(episodes=2)
    half = dataclasses.replace(QUICK, validation_fraction=0.5, epochs=1)
    _, encoding, _ = train_dropout_vgg(demos, 0, half)
    means = [demos.episode(episode).mean(axis=0) for episode in (0, 1)]
    mean = -encoding.offset / encoding.scale
    matches = [np.allclose(mean, each, atol=0.02) for each in means]
    assert sorted(matches) == [False, True]


def test_the_paper_literal_learner_trains_saves_and_loads(tmp_path):
    options = {**SMALL, "epochs": 1}
    learner = PaperLiteralLearner.train(demonstrations(), 0, options)
    assert learner.config.frames == 1 and learner.config.channels == (8, 8)
    loaded = PaperLiteralLearner.load(learner.save(tmp_path))
    assert isinstance(loaded, PaperLiteralLearner) and loaded.config == learner.config


def test_wrong_demonstrations_are_refused():
    demos = demonstrations()
    with pytest.raises(ValueError, match=r"images of shape \(n, H, W, C\).*float64"):
        train_dropout_vgg(dataclasses.replace(demos, observations=demos.observations / 255.0), 0, QUICK)
    with pytest.raises(ValueError, match="not finite in actions"):
        train_dropout_vgg(dataclasses.replace(demos, actions=demos.actions * np.nan), 0, QUICK)
    with pytest.raises(ValueError, match=r"few enough blocks"):
        train_dropout_vgg(demos, 0, VGGConfig(epochs=1, pools=2))
    with pytest.raises(ValueError, match="unknown device 'gpu'"):
        train_dropout_vgg(demos, 0, QUICK, device="gpu")
    with pytest.raises(ValueError, match=r"shape \(n, d\)"):
        BayesianLearner.train(demos, 0, {"epochs": 1})
