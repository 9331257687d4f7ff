from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

import safeswitch
from safeswitch import datasets, demos
from safeswitch.datasets import METADATA, EpisodeFrames, write
from safeswitch.demos import Demonstrations, Noise, Rollout, collect, load, roll_out

ENV = "SafeSwitch/CartPole-v0"
DATASET = "safeswitch/cart-pole/expert-v0"
SEEDS = [3, 14, 15]
NOISE = Noise(low=0.1, high=0.1)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("datasets")
    collect(ENV, DATASET, root, SEEDS, noise=NOISE)
    return root


@pytest.fixture(scope="module")
def data(root) -> Demonstrations:
    return load(DATASET, root)


@pytest.fixture(scope="module")
def episodes(root):
    with datasets.minari_root(root):
        import minari

        dataset = minari.load_dataset(DATASET)
    return list(dataset.iterate_episodes()), dataset


class Pictures(gym.Env):
    observation_space = gym.spaces.Box(0, 255, (32, 32, 3), np.uint8)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)


def equal(a: Rollout, b: Rollout) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in Rollout.__dataclass_fields__)


def test_the_expert_succeeds_in_spite_of_the_noise(data):
    assert data.settings["success"] == [True] * len(SEEDS)


def test_read_back_from_minari_it_is_what_was_rolled_out(data):
    rollouts = list(roll_out(ENV, SEEDS, NOISE))
    np.testing.assert_array_equal(data.observations, np.concatenate([each.observations[:-1] for each in rollouts]))
    np.testing.assert_array_equal(data.actions, np.concatenate([each.labels[:-1] for each in rollouts]))
    np.testing.assert_array_equal(data.episodes, np.repeat(range(len(SEEDS)), [len(each.actions) for each in rollouts]))
    assert data.observations.dtype == np.float32 and data.actions.dtype == np.float64


def test_same_bits_for_any_number_of_workers(monkeypatch):
    monkeypatch.setattr(demos, "CHUNK", 2)
    one, two = (list(roll_out(ENV, SEEDS, NOISE, n_jobs=n_jobs)) for n_jobs in (1, 2))
    assert [each.seed for each in two] == SEEDS
    assert all(equal(a, b) for a, b in zip(one, two, strict=True))


def test_an_episode_does_not_depend_on_those_before_it():
    last = list(roll_out(ENV, SEEDS, NOISE))[-1]
    assert equal(last, next(iter(roll_out(ENV, SEEDS[-1:], NOISE))))


def test_executed_actions_replay_the_episode_bit_for_bit(episodes):
    env = gym.make(ENV).unwrapped
    for episode, seed in zip(episodes[0], SEEDS, strict=True):
        observation, info = env.reset(seed=seed)
        for step, action in enumerate(episode.actions):
            np.testing.assert_array_equal(observation, episode.observations[step])
            np.testing.assert_array_equal(info["state"], episode.infos["state"][step])
            observation, reward, terminated, truncated, info = env.step(action)
            assert reward == episode.rewards[step]
        np.testing.assert_array_equal(observation, episode.observations[-1])
        assert (terminated, truncated) == (episode.terminations[-1], episode.truncations[-1])
    env.close()


def test_labels_are_the_clean_actions_of_the_expert(episodes):
    env = gym.make(ENV).unwrapped
    env.reset(seed=SEEDS[0])
    expert = env.make_expert()
    expert.reset()
    episode = episodes[0][0]
    for state, label in zip(episode.infos["state"][:20], episode.infos["expert_action"], strict=False):
        np.testing.assert_array_equal(expert.action(state, env.parameters), label)
    env.close()


def test_executed_actions_are_labels_plus_noise_within_the_bounds(episodes):
    for episode, seed in zip(episodes[0], SEEDS, strict=True):
        noise = NOISE.draw(seed, len(episode.actions), 1)
        expected = np.clip(episode.infos["expert_action"][:-1] + noise, -1, 1).astype(np.float32)
        np.testing.assert_array_equal(episode.actions, expected)


@pytest.mark.filterwarnings("ignore:Package safeswitch is not installed")
def test_metadata_says_what_it_is(episodes):
    metadata = episodes[1].storage.metadata
    assert metadata["algorithm_name"].startswith("MPC")
    assert metadata["author"] and "3 of them successful" in metadata["description"]
    settings = json.loads(metadata[METADATA])
    assert settings["seeds"] == SEEDS and settings["env"] == ENV
    assert settings["noise"]["high"] == 0.1
    assert episodes[1].recover_environment().unwrapped.task == "cart-pole"


def test_collecting_again_replaces_the_dataset_and_leaves_nothing_behind(root, tmp_path):
    collect(ENV, DATASET, tmp_path, SEEDS[:2], noise=NOISE)
    first = (tmp_path / DATASET / "data" / "main_data.hdf5").read_bytes()
    collect(ENV, DATASET, tmp_path, SEEDS[:1], noise={"low": 0.0, "high": 0.0})
    again = load(DATASET, tmp_path)
    assert again.settings["seeds"] == SEEDS[:1] and set(again.episodes) == {0}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["safeswitch"]
    collect(ENV, DATASET, tmp_path, SEEDS[:2], noise=NOISE)
    assert (tmp_path / DATASET / "data" / "main_data.hdf5").read_bytes() == first, "the file differs between runs"


def test_an_interruption_keeps_the_older_dataset(root, tmp_path, monkeypatch):
    collect(ENV, DATASET, tmp_path, SEEDS[:1], noise=NOISE)

    def fail(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(datasets, "_move", fail)
    with pytest.raises(KeyboardInterrupt):
        collect(ENV, DATASET, tmp_path, SEEDS[:2], noise=NOISE)
    assert load(DATASET, tmp_path).settings["seeds"] == SEEDS[:1]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["safeswitch"]


def test_progress_counts_the_demonstrations(tmp_path):
    seen: list[tuple[int, int]] = []
    collect(ENV, DATASET, tmp_path, SEEDS[:2], progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 2), (2, 2)]


@pytest.fixture
def pictures(tmp_path, monkeypatch):
    """Rollouts with images (2, 41, 32, 32, 3), in a dataset of their own; the root, and Minari's view of it."""
    spec = gym.envs.registration.EnvSpec("Pictures-v0", f"{__name__}:Pictures")
    monkeypatch.setitem(sys.modules, __name__, sys.modules.get(__name__) or SimpleNamespace(Pictures=Pictures))
    monkeypatch.setitem(gym.registry, "Pictures-v0", spec)
    rng = np.random.default_rng(0)
    images = np.repeat(rng.integers(0, 255, (2, 4, 1, 3), np.uint8), 8, axis=1).repeat(32, axis=2)[:, None]
    images = np.repeat(images, 41, axis=1)
    images[:, :, 5, :, 0] = np.arange(41)[:, None]  # every frame differs
    rollouts = [
        Rollout(
            seed,
            True,
            images[seed],
            rng.uniform(-1, 1, (40, 1)).astype(np.float32),
            rng.uniform(-1, 1, (41, 1)),
            rng.normal(size=(41, 2)),
            np.zeros(40),
            np.zeros(40, bool),
            np.arange(40) == 39,
        )
        for seed in range(2)
    ]
    write(rollouts, "Pictures-v0", "pictures/expert-v0", tmp_path, Noise())
    with datasets.minari_root(tmp_path):
        import minari

        return rollouts, tmp_path, minari.load_dataset("pictures/expert-v0")


def test_images_are_kept_without_loss_and_compressed(pictures):
    rollouts, root, dataset = pictures
    for rollout, episode in zip(rollouts, dataset.iterate_episodes(), strict=True):
        np.testing.assert_array_equal(episode.observations, rollout.observations)
        np.testing.assert_array_equal(episode.actions, rollout.actions)
        np.testing.assert_array_equal(episode.infos["expert_action"], rollout.labels)
        np.testing.assert_array_equal(episode.infos["state"], rollout.states)
        np.testing.assert_array_equal(episode.truncations, rollout.truncated)
    raw = sum(rollout.observations.nbytes for rollout in rollouts)
    assert (root / "pictures/expert-v0/data/main_data.hdf5").stat().st_size < raw / 4
    assert isinstance(dataset.recover_environment().unwrapped, Pictures)


def test_images_stay_in_their_file_until_an_episode_is_asked_for(pictures):
    rollouts, root, _ = pictures
    data = load("pictures/expert-v0", root)
    frames = data.observations
    assert isinstance(frames, EpisodeFrames)
    assert (len(data), frames.shape, frames.dtype, frames.ndim) == (80, (80, 32, 32, 3), np.uint8, 4)
    assert len(pickle.dumps(data)) < 10_000, "the images travel with the demonstrations"
    for index, rollout in enumerate(rollouts):
        np.testing.assert_array_equal(data.episode(index), rollout.observations[:-1])
        np.testing.assert_array_equal(data.actions[data.steps(index)], rollout.labels[:-1])
    np.testing.assert_array_equal(np.asarray(frames), np.concatenate([each.observations[:-1] for each in rollouts]))


def test_an_episode_of_vectors_is_its_rows(data):
    for index in range(len(SEEDS)):
        np.testing.assert_array_equal(data.episode(index), data.observations[data.episodes == index])


def test_the_first_episodes_are_a_set_of_demonstrations(data, pictures):
    part = data.first(2)
    end = data.steps(1).stop
    assert len(part) == end == len(part.actions) == len(part.executed) and set(part.episodes) == {0, 1}
    np.testing.assert_array_equal(part.observations, data.observations[:end])
    assert len(data.first(10_000)) == len(data)
    rollouts, root, _ = pictures
    images = load("pictures/expert-v0", root).first(1)
    assert len(images) == 40 and images.observations.shape == (40, 32, 32, 3)
    np.testing.assert_array_equal(images.episode(0), rollouts[0].observations[:-1])
    np.testing.assert_array_equal(images.executed, rollouts[0].actions)


def test_noise_has_the_promised_size_and_correlation():
    rows = np.array([Noise(0.2, 0.2, 1.0, 0.8).draw(seed, 300, 1)[:, 0] for seed in range(100)])
    np.testing.assert_allclose(rows.std(axis=0).mean(), 0.2, rtol=0.02)
    assert np.corrcoef(rows[:, :-1].ravel(), rows[:, 1:].ravel())[0, 1] == pytest.approx(0.8, abs=0.015)
    white = np.array([Noise(0.2, 0.2).draw(seed, 300, 1)[:, 0] for seed in range(100)])
    assert abs(np.corrcoef(white[:, :-1].ravel(), white[:, 1:].ravel())[0, 1]) < 0.02
    sizes = np.array([Noise(0.0, 0.2).draw(seed, 300, 1).std() for seed in range(100)])
    assert sizes.min() < 0.02 and 0.18 < sizes.max() < 0.22


def test_wrong_settings_are_refused(tmp_path, root):
    with pytest.raises(ValueError, match="low=0.3, high=0.2"):
        Noise(0.3, 0.2)
    with pytest.raises(ValueError, match="unknown noise setting 'hihg'; valid, nearest first: high"):
        collect(ENV, DATASET, tmp_path, SEEDS, noise={"hihg": 0.1})
    with pytest.raises(ValueError, match="seeds is empty"):
        collect(ENV, DATASET, tmp_path, [])
    with pytest.raises(ValueError, match="must differ"):
        collect(ENV, DATASET, tmp_path, [1, 1])
    with pytest.raises(FileNotFoundError, match=f"expert-v1.*{DATASET}"):
        load("safeswitch/cart-pole/expert-v1", root)


def test_importing_it_needs_neither_torch_nor_the_baselines_nor_minari():
    heavy = ("torch", "minari", "safeswitch_baselines")
    code = f"import sys, safeswitch.demos; print([name for name in {heavy} if name in sys.modules])"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
    assert safeswitch.ENTRY_POINTS[ENV]
