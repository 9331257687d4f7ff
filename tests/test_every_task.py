"""What holds for every task: generated from the registry, so that a new task is tested the day it is registered."""

from __future__ import annotations

import importlib
import json
import math
import pickle
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import safeswitch
from safeswitch.protocols import Expert
from safeswitch.tasks.base import TaskEnv
from safeswitch.tasks.disturbances import DISTURBANCES, offered

IDS = sorted(safeswitch.ENTRY_POINTS)
INFO_KEYS = {"state", "parameters", "is_success", "disturbed", "step", "onset"}


def task_class(env_id: str) -> type[TaskEnv]:
    """Class of an environment id."""
    module, _, name = safeswitch.ENTRY_POINTS[env_id].partition(":")
    return getattr(importlib.import_module(module), name)


CELLS = [(env_id, name) for env_id in IDS for name in (None, *offered(task_class(env_id).task))]


def make(env_id: str, **kwargs: Any) -> TaskEnv:
    """The bare environment."""
    return gym.make(env_id, **kwargs).unwrapped  # type: ignore[return-value]


def rollout(env: TaskEnv, seed: int, steps: int = 25) -> list[Any]:
    """Observations, rewards and infos of random actions."""
    rng = np.random.default_rng(seed)
    record: list[Any] = list(env.reset(seed=seed))
    while not env.done and env.step_index < steps:
        action = rng.uniform(-0.5, 0.5, env.action_space.shape).astype(np.float32)
        record.extend(env.step(action))
    return record


def assert_same(first: Any, second: Any) -> None:
    """Equality to the last bit, of nested lists and dicts of arrays."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_same(first[key], second[key])
    elif isinstance(first, list):
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            assert_same(one, other)
    else:
        np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(("env_id", "disturbance"), CELLS)
def test_gymnasium_accepts_it_without_warnings(env_id: str, disturbance: str | None) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make(env_id, disturbance=disturbance, severity=5)
        check_env(env, skip_render_check=True)
        env.close()


@pytest.mark.rendering
@pytest.mark.parametrize("env_id", IDS)
def test_gymnasium_accepts_its_pictures(env_id: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make(env_id, render_mode="rgb_array")
        check_env(env)
        assert env.metadata["render_modes"] == ["rgb_array"]
        assert env.metadata["render_fps"] == round(1.0 / env.control_dt)
        env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_registration(env_id: str) -> None:
    gym.register_envs(safeswitch)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        safeswitch.register()  # registering again is silent
        assert isinstance(gym.make(f"safeswitch:{env_id}").unwrapped, TaskEnv)


@pytest.mark.parametrize(("env_id", "disturbance"), CELLS)
def test_an_episode_is_a_function_of_its_seed(env_id: str, disturbance: str | None) -> None:
    env, other = make(env_id, disturbance=disturbance), make(env_id, disturbance=disturbance)
    first = rollout(env, 11)
    assert_same(first, rollout(other, 11))
    rollout(env, 12)
    assert_same(first, rollout(env, 11))
    assert not np.array_equal(env.reset(seed=12)[1]["state"], first[1]["state"])


@pytest.mark.parametrize("env_id", IDS)
def test_episodes_without_a_seed_differ_and_can_be_replayed(env_id: str) -> None:
    env = make(env_id)
    env.reset(seed=1)
    states = []
    for _ in range(3):
        env.reset()
        states.append(env.state)
    assert not np.array_equal(states[0], states[1]) and not np.array_equal(states[1], states[2])
    np.testing.assert_array_equal(env.reset(seed=env.episode_seed)[1]["state"], states[2])


@pytest.mark.parametrize(("env_id", "disturbance"), CELLS)
def test_info_has_the_same_keys_and_types_always(env_id: str, disturbance: str | None) -> None:
    env = make(env_id, disturbance=disturbance)
    _, info = env.reset(seed=3)
    infos = [info]
    action = np.zeros(env.action_space.shape, np.float32)
    while not env.done:
        infos.append(env.step(action)[4])
    for step, info in enumerate(infos):
        assert set(info) == INFO_KEYS
        assert type(info["is_success"]) is bool and type(info["disturbed"]) is bool
        assert type(info["step"]) is int and info["step"] == step
        assert type(info["onset"]) is int
        # A placed disturbance has T for its onset until it comes into view.
        pending = disturbance is not None and env.disturbance.placed and (env.onset is None or step < env.onset)
        assert info["onset"] == (-1 if disturbance is None else env.horizon if pending else env.onset)
        assert info["disturbed"] == (disturbance is not None and not pending and step >= info["onset"])
        assert info["state"].dtype == info["parameters"].dtype == np.float64
        assert info["parameters"].shape == (len(env.parameter_names),)
    infos[0]["state"][:] = math.nan  # infos are copies
    assert np.isfinite(env.state).all()


@pytest.mark.parametrize("env_id", IDS)
def test_specs_are_json(env_id: str) -> None:
    name = offered(task_class(env_id).task)[0]
    env = gym.make(env_id, disturbance=name, severity=2)
    again = gym.make(EnvSpec.from_json(json.dumps(json.loads(env.spec.to_json()))))
    assert again.unwrapped.disturbance.name == name and again.unwrapped.disturbance.severity == 2


@pytest.mark.parametrize(("env_id", "disturbance"), CELLS)
def test_pickled_environments_continue(env_id: str, disturbance: str | None) -> None:
    env = gym.make(env_id, disturbance=disturbance)
    env.reset(seed=5)
    for _ in range(8):
        env.step(np.full(env.action_space.shape, -0.1, np.float32))
    again = pickle.loads(pickle.dumps(env))
    assert again.spec == env.spec
    action = np.full(env.action_space.shape, 0.1, np.float32)
    assert_same(list(env.step(action)), list(again.step(action)))
    assert_same(list(env.reset()), list(again.reset()))
    assert len(pickle.dumps(env.unwrapped)) < 20_000, "the simulator is not in the pickle"


@pytest.mark.parametrize(("mode", "context"), [("sync", None), ("async", "spawn"), ("async", "forkserver")])
@pytest.mark.parametrize("env_id", IDS)
def test_vector_environments(env_id: str, mode: str, context: str | None) -> None:
    name = offered(task_class(env_id).task)[0]
    kwargs = {} if context is None else {"vector_kwargs": {"context": context}}
    envs = gym.make_vec(env_id, num_envs=2, vectorization_mode=mode, disturbance=name, **kwargs)
    try:
        observations, infos = envs.reset(seed=[7, 8])
        action = np.zeros(envs.action_space.shape, np.float32)
        stepped = envs.step(action)[0]
        for index, seed in enumerate((7, 8)):
            single = make(env_id, disturbance=name)
            np.testing.assert_array_equal(single.reset(seed=seed)[0], observations[index])
            np.testing.assert_array_equal(single.step(action[index])[0], stepped[index])
            assert infos["onset"][index] == single.onset
    finally:
        envs.close()


@pytest.mark.parametrize("env_id", IDS)
def test_invalid_actions_are_refused_and_change_nothing(env_id: str) -> None:
    env = make(env_id)
    nu = env.action_space.shape[0]
    with pytest.raises(RuntimeError, match="has not begun"):
        env.advance(np.zeros(nu))
    env.reset(seed=0)
    before = env.snapshot()
    for bad in (math.nan, math.inf, -math.inf):
        with pytest.raises(ValueError, match="must be finite"):
            env.step(np.full(nu, bad, np.float32))
    for shape in ((), (nu + 1,), (1, nu)):
        with pytest.raises(ValueError, match="an action has shape"):
            env.step(np.zeros(shape, np.float32))
    np.testing.assert_array_equal(env.snapshot(), before)


@pytest.mark.parametrize("env_id", IDS)
def test_actions_are_clipped(env_id: str) -> None:
    env = make(env_id)
    ends = []
    for scale in (1.0, 50.0):
        env.reset(seed=0)
        env.advance(np.full(env.action_space.shape, scale))
        ends.append(env.snapshot())
    np.testing.assert_array_equal(*ends)


@pytest.mark.parametrize(("env_id", "disturbance"), CELLS)
def test_advance_is_step_without_looking(env_id: str, disturbance: str | None) -> None:
    env, other = make(env_id, disturbance=disturbance), make(env_id, disturbance=disturbance)
    options = None if disturbance is None or env.disturbance.placed else {"onset": 3}
    env.reset(seed=9, options=options)
    other.reset(seed=9, options=options)
    action = np.full(env.action_space.shape, 0.05)
    for _ in range(10):
        env.step(action)
        assert other.advance(action) is None
        np.testing.assert_array_equal(env.snapshot(), other.snapshot())


@pytest.mark.parametrize("env_id", IDS)
def test_each_task_offers_enough(env_id: str) -> None:
    classes = [DISTURBANCES[name] for name in offered(task_class(env_id).task)]
    assert len(classes) >= 6 and any(cls.benign for cls in classes)
    assert len({cls.kind for cls in classes}) == 4


@pytest.mark.parametrize("env_id", IDS)
def test_documentation_has_tables_of_every_quantity(env_id: str) -> None:
    text = task_class(env_id).__doc__ or ""
    for heading in ("## Observation", "## Action", "## Reward", "## Info", "| unit |", *INFO_KEYS):
        assert heading in text, heading
    for name in (*task_class(env_id).parameter_names, *offered(task_class(env_id).task)):
        assert name in text, name


@pytest.mark.parametrize("env_id", IDS)
def test_the_expert_knows_the_task(env_id: str) -> None:
    env = make(env_id)
    env.reset(seed=0)
    expert = env.make_expert()
    assert isinstance(expert, Expert)
    expert.reset()
    action = expert.action(env.state, env.parameters)
    assert action.shape == env.action_space.shape and (np.abs(action) <= 1).all()
