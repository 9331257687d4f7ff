"""What users of Gymnasium, Minari, stable-baselines3 and TensorBoard expect to work, for every registered id."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import safeswitch
from micro import leaderboard_bytes, micro_run
from safeswitch import cli, datasets, demos, suite
from safeswitch.protocols import Expert

IDS = sorted(safeswitch.ENTRY_POINTS)
TASKS = sorted(suite.TASKS)


def drive(env: Any, steps: int = 400) -> tuple[int, dict[str, Any]]:
    """Random actions to the end of an episode: its length, and the last info."""
    env.action_space.seed(1)
    env.reset(seed=3)
    for step in range(1, steps + 1):
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        if terminated or truncated:
            return step, info
    raise AssertionError(f"the episode did not end within {steps} steps")


# ---- Gymnasium


@pytest.mark.parametrize("env_id", IDS)
def test_frames_are_stacked_oldest_first(env_id: str) -> None:
    env = gym.wrappers.FrameStackObservation(gym.make(env_id), 3)
    first, _ = env.reset(seed=1)
    env.action_space.seed(1)
    second = env.step(env.action_space.sample())[0]
    assert env.observation_space.contains(first) and env.observation_space.contains(second)
    np.testing.assert_array_equal(second[1], first[2])
    assert first.shape == second.shape == (3, *env.unwrapped.observation_space.shape)
    env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_episode_statistics_are_recorded(env_id: str) -> None:
    env = gym.wrappers.RecordEpisodeStatistics(gym.make(env_id))
    total, steps = 0.0, 0
    env.action_space.seed(1)
    env.reset(seed=3)
    over = False
    while not over:
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        total, steps, over = total + float(reward), steps + 1, terminated or truncated
    assert info["episode"]["l"] == steps and info["episode"]["r"] == pytest.approx(total)
    env.close()


@pytest.mark.slow
@pytest.mark.rendering
@pytest.mark.parametrize("env_id", IDS)
def test_videos_are_recorded(env_id: str, tmp_path: Path) -> None:
    pytest.importorskip("moviepy", reason="gymnasium.wrappers.RecordVideo needs moviepy")
    env = gym.make(env_id, render_mode="rgb_array")
    if "rgb_array" not in env.metadata["render_modes"]:
        pytest.skip("it has no picture")
    options = {"episode_trigger": lambda episode: True, "fps": 20, "disable_logger": True}  # at 17 it loses a frame
    env = gym.wrappers.RecordVideo(env, str(tmp_path), **options)
    steps, _ = drive(env)
    assert len(env.recorded_frames) == steps + 1, "the first observation and one after each step"
    env.close()
    (film,) = tmp_path.glob("*.mp4")
    import imageio.v3 as iio

    frames = iio.imread(film, plugin="FFMPEG")
    # moviepy counts in floating-point seconds, and may show the last frame twice.
    assert len(frames) in (steps + 1, steps + 2) and frames.std() > 1


@pytest.mark.parametrize("env_id", IDS)
def test_vectors_of_environments_go_on_to_the_next_episode(env_id: str) -> None:
    envs = gym.make_vec(env_id, num_envs=2, vectorization_mode="sync")
    envs.reset(seed=[1, 2])
    action = np.ones(envs.action_space.shape, envs.action_space.dtype)  # full throttle: most tasks soon end
    ends = 0
    for _ in range(300):
        observations, _, terminated, truncated, infos = envs.step(action)
        ends += int((terminated | truncated).sum())
        if ends >= 2:
            break
    assert ends >= 2
    envs.step(action)  # autoreset on the next step, Gymnasium's default
    assert envs.observation_space.contains(observations) and len(infos["step"]) == 2
    envs.close()


@pytest.mark.slow
@pytest.mark.parametrize("env_id", IDS)
def test_vectors_in_processes_give_the_same_numbers(env_id: str) -> None:
    records = []
    for mode in ("sync", "async"):
        options = {} if mode == "sync" else {"vector_kwargs": {"context": "spawn"}}
        envs = gym.make_vec(env_id, num_envs=2, vectorization_mode=mode, **options)
        envs.action_space.seed(0)
        rows = [envs.reset(seed=[1, 2])[0]]
        rows += [envs.step(envs.action_space.sample())[0] for _ in range(8)]
        records.append(np.stack(rows))
        envs.close()
    np.testing.assert_array_equal(*records)


# ---- stable-baselines3


@pytest.mark.slow
@pytest.mark.parametrize("env_id", IDS)
def test_stable_baselines_trains_on_it(env_id: str) -> None:
    sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra rl")
    from stable_baselines3.common.env_checker import check_env

    env = gym.make(env_id)
    check_env(env.unwrapped, warn=False, skip_render_check=True)
    policy = "CnnPolicy" if len(env.observation_space.shape) == 3 else "MlpPolicy"
    model = sb3.PPO(policy, env, n_steps=128, batch_size=64, n_epochs=1, seed=0, device="cpu")
    before = [value.clone() for value in model.policy.parameters()]
    model.learn(256)
    moved = [bool((old != new).any()) for old, new in zip(before, model.policy.parameters(), strict=True)]
    assert any(moved) and all(bool(value.isfinite().all()) for value in model.policy.parameters())
    action, _ = model.predict(env.reset(seed=1)[0], deterministic=True)
    assert env.action_space.contains(action)
    env.close()


# ---- Minari


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_demonstrations_are_a_complete_minari_dataset(name: str, tmp_path: Path) -> None:
    task = suite.task(name)
    settings = {key: value for key, value in task.demonstrations.items() if key != "episodes"}
    demos.collect(task.env_id, task.dataset, tmp_path, range(2), **settings)
    with datasets.minari_root(tmp_path):
        import minari

        assert task.dataset in minari.list_local_datasets()
        dataset = minari.load_dataset(task.dataset)
        metadata = dataset.storage.metadata
        for key in ("description", "algorithm_name", "author", "minari_version", "requirements", "dataset_size"):
            assert metadata.get(key), key
        assert dataset.total_episodes == 2 and dataset.total_steps == sum(len(each) for each in dataset)
        env: Any = dataset.recover_environment()
        assert env.spec.id == task.env_id and isinstance(env.unwrapped.make_expert(), Expert)
        assert dataset.observation_space == env.observation_space and dataset.action_space == env.action_space
        for episode in dataset:
            assert episode.infos["expert_action"].shape == (len(episode) + 1, *env.action_space.shape)
            assert all(env.observation_space.contains(each) for each in episode.observations[:3])
            assert episode.terminations[-1] or episode.truncations[-1]
        np.testing.assert_array_equal(env.reset(seed=0)[0], dataset[0].observations[0])
        env.close()


# ---- TensorBoard


def scalars(folder: Path) -> dict[str, list[float]]:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    return {name: [each.value for each in events.Scalars(name)] for name in events.Tags()["scalars"]}


@pytest.mark.slow
def test_tensorboard_shows_what_was_computed_and_changes_no_bit(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="needs the extra tensorboard")
    from safeswitch import board
    from safeswitch.files import load_arrays

    run = micro_run(tmp_path / "store")
    table = leaderboard_bytes(run)
    kept = {path: path.read_bytes() for path in (tmp_path / "store").rglob("*") if path.is_file()}
    for _ in range(2):  # written again, not twice
        board.write_training(run, tmp_path / "curves")
        board.write_searches(run, tmp_path / "curves")
    assert {path: path.read_bytes() for path in (tmp_path / "store").rglob("*") if path.is_file()} == kept
    assert leaderboard_bytes(micro_run(tmp_path / "store")) == table
    shown = scalars(tmp_path / "curves" / "cart-pole" / "learner-0")
    history = run.trained[0].learner(run.task).history
    assert set(shown) == {f"training/{name}" for name in history}
    np.testing.assert_allclose(shown["training/loss"], history["loss"], rtol=1e-6)
    cem = scalars(tmp_path / "curves" / str(run.task.paper_cell) / "learner-0")
    log = load_arrays(run.store.folder(run.episodes[0].key) / "logs.npz")
    for name in ("mu", "sigma", "reward_sum", "accepted"):
        np.testing.assert_allclose(cem[f"onset/cem@total/{name}"], log[f"onset|cem@total|{name}"], rtol=1e-6)


def test_without_tensorboard_the_flag_is_refused_before_anything_is_computed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    import importlib.util

    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "tensorboard" else found(name))
    for command in ("bench", "train"):
        options = ["--store", str(tmp_path / "store"), "--tensorboard", str(tmp_path / "curves")]
        assert cli.main([command, *options]) == 2
        captured = capsys.readouterr()
        assert "safeswitch[tensorboard]" in captured.out + captured.err
    assert not list(tmp_path.iterdir())
