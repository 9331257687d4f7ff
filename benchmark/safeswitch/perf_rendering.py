"""How fast pictures come, beside bare loops of `mujoco.Renderer` in the same run; a decision from images.

Each alternative draws the same states of the same model through the same camera at 64 x 64. A round times all of them
one after the other, so that a busy machine slows all; ratios are medians over rounds. The bare loops use
`mujoco.Renderer` as it comes (the quality that the model asks for), and with the settings of our fast pictures.

``python -m safeswitch.perf`` prints all of it.
"""

from __future__ import annotations

import copy
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safeswitch import demos, registry, suite
from safeswitch.protocols import Learner
from safeswitch.tasks.base import TaskEnv
from safeswitch.tasks.opengl import describe_renderer
from safeswitch.tasks.rendering import Image, Renderer, quality, simplify

SIZE = 64
"""Width and height of a picture [pixel]."""

ENV_IDS = ("SafeSwitch/CartPoleImage-v0", "SafeSwitch/CartPole-v0")
"""Whose model is drawn: the first that is registered. Its steps are timed if pictures are its observations."""

STATES = 20
"""Different states that are drawn."""

Draw = Callable[[mujoco.MjData], object]


def rendering_benchmark(repeats: int = 7, frames: int = 60) -> dict[str, Any]:
    """Frames per second of each way to draw, and ratios to the bare loops.

    Args:
        repeats: rounds; medians are reported.
        frames: drawn by each alternative in each round.

    Returns:
        Plain numbers and strings.
    """
    env_id = next(each for each in ENV_IDS if each in gym.registry)
    env = gym.make(env_id).unwrapped
    assert isinstance(env, TaskEnv)
    states = visited(env, STATES)
    with ExitStack() as stack:
        stack.callback(env.close)
        ways: dict[str, Callable[[], float]] = {
            name: rate(draw, states, frames) for name, draw in drawings(env, stack).items()
        }
        if len(env.observation_space.shape or ()) == 3:
            ways["environment"] = lambda: steps_per_second(env, frames)
        for way in ways.values():
            way()  # what is compiled and loaded by the first frames is not measured
        rounds = [{name: way() for name, way in ways.items()} for _ in range(repeats)]
    found = describe_renderer()
    results: dict[str, Any] = {"model": env_id, "drawn by": f"{found.backend}: {found.renderer}"}
    results |= {f"{name} [frames/s]": median(each[name] for each in rounds) for name in ways}
    for name in [name for name in ("fast", "environment") if name in ways]:
        for bare in ("bare default", "bare fast"):
            results[f"{name} / {bare}"] = median(each[name] / each[bare] for each in rounds)
    return results


def drawings(env: TaskEnv, stack: ExitStack) -> dict[str, Draw]:
    """A function for each way to draw; `stack` frees what they hold."""
    model, camera = env.simulator.nominal, env.camera
    fast = Renderer(model, SIZE, SIZE, camera, fast=True)
    stack.callback(fast.close)
    return {
        "bare default": bare(model, camera, stack, fast=False),
        "bare fast": bare(model, camera, stack, fast=True),
        "fast": lambda data: fast.render(model, data),
    }


def bare(model: mujoco.MjModel, camera: str, stack: ExitStack, *, fast: bool) -> Draw:
    """The loop as MuJoCo's tutorial has it, with our fast settings or with the model's."""
    if fast:
        with quality(model, SIZE, SIZE, fast=True):
            renderer = mujoco.Renderer(model, SIZE, SIZE)
        simplify(renderer.scene)
    else:
        renderer = mujoco.Renderer(model, SIZE, SIZE)

    def close() -> None:
        renderer.render()  # makes its context the current one: `close` frees in whichever is
        renderer.close()

    def draw(data: mujoco.MjData) -> Image:
        renderer.update_scene(data, camera)
        return renderer.render()

    stack.callback(close)
    return draw


def visited(env: TaskEnv, count: int) -> list[mujoco.MjData]:
    """The first `count` states of an episode under random actions, ready to be drawn."""
    env.reset(seed=0)
    rng, states = np.random.default_rng(0), []
    for _ in range(count):
        env.advance(rng.uniform(-1.0, 1.0, env.simulator.action_shape))
        env.simulator.update_kinematics(env.simulator.nominal)
        states.append(copy.copy(env.simulator.data))
    return states


def rate(draw: Draw, states: Sequence[mujoco.MjData], frames: int) -> Callable[[], float]:
    """A function that draws `frames` of the states and returns the frames per second."""

    def timed() -> float:
        start = time.perf_counter()
        for i in range(frames):
            draw(states[i % len(states)])
        return frames / (time.perf_counter() - start)

    return timed


def steps_per_second(env: gym.Env[Any, Any], frames: int) -> float:
    """Whole steps of an environment per second: physics, picture and info; a reset where an episode ends."""
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (frames, *(env.action_space.shape or ()))).astype(np.float32)
    start = time.perf_counter()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset(seed=0)
    return frames / (time.perf_counter() - start)


def decision_benchmark() -> dict[str, float]:
    """Milliseconds of a decision of the image task's learner, K samples: trunk shared, and dropout in the trunk too.

    Trained for one epoch on two episodes: the weights make no difference to the time.
    """
    task = suite.task("cart-pole-image")
    train = registry.find("learner", task.learner).train
    with tempfile.TemporaryDirectory() as folder:
        demos.collect(task.env_id, task.dataset, Path(folder), suite.episode_seeds("train", 2))
        data = demos.load(task.dataset, Path(folder))
        learners = {
            name: train(data, 0, {**task.learner_options, "epochs": 1, **more})
            for name, more in {"trunk shared": {}, "dropout everywhere": {"trunk_dropout": 0.1}}.items()
        }
        return decision_ms(learners, data.episode(0))


def decision_ms(learners: Mapping[str, Learner], frames: NDArray[np.uint8], repeats: int = 5) -> dict[str, float]:
    """Milliseconds of a decision (one `predict`) of each learner, and its ratio to the first learner's.

    Args:
        learners: by the names under which they are reported; one that shares its trunk and one with dropout
            everywhere, for example.
        frames: (n, height, width, 3), shown one after the other as the observations of an episode.
        repeats: rounds, in each of which every learner is timed once; medians are reported.

    Returns:
        ``"<name> [ms]"`` for each, and ``"<name> / <first>"`` for all but the first.
    """
    if not learners or not len(frames):
        raise ValueError(f"need at least one learner and one frame, got {len(learners)} and {len(frames)}")
    rounds = []
    for learner in learners.values():
        episode_ms(learner, frames[:2])
    for _ in range(repeats):
        rounds.append({name: episode_ms(learner, frames) for name, learner in learners.items()})
    first, *others = learners
    results = {f"{name} [ms]": median(each[name] for each in rounds) for name in learners}
    return results | {f"{name} / {first}": median(each[name] / each[first] for each in rounds) for name in others}


def episode_ms(learner: Learner, frames: NDArray[np.uint8]) -> float:
    """Milliseconds of a decision, the mean over an episode that shows `frames`."""
    learner.reset(0)
    start = time.perf_counter()
    for step, frame in enumerate(frames):
        learner.predict(frame, step)
    return 1e3 * (time.perf_counter() - start) / len(frames)
