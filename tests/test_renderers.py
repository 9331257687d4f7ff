"""Renderers come and go, in threads, processes and vector environments, without touching each other's pictures."""

from __future__ import annotations

import gc
import multiprocessing
import os
import subprocess
import sys
import threading
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

import safeswitch  # noqa: F401  (registers the ids)
from safeswitch.tasks import rendering
from safeswitch.tasks.cart_pole import CartPoleEnv
from safeswitch.tasks.rendering import Renderer


def start(env: CartPoleEnv, x: float, theta: float) -> NDArray:
    """Picture of the environment at a given start."""
    env.reset(seed=0, options={"initial_state": [x, 0.0, theta, 0.0]})
    picture = env.render()
    assert picture is not None
    return picture


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `code` in a fresh interpreter in which every warning is an error."""
    command = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True, timeout=120)


@pytest.fixture
def env():
    env = CartPoleEnv(render_mode="rgb_array", width=96, height=64)
    yield env
    env.close()


@pytest.mark.rendering
def test_closing_one_renderer_leaves_the_others_alone() -> None:
    envs = [CartPoleEnv(render_mode="rgb_array", width=96 + 32 * i, height=64) for i in range(3)]
    before = [start(env, 0.1 * i, 0.3) for i, env in enumerate(envs)]
    envs[1].close()
    envs[1].close()
    for i in (0, 2):
        np.testing.assert_array_equal(start(envs[i], 0.1 * i, 0.3), before[i])
    envs.pop()  # collected without being closed
    np.testing.assert_array_equal(start(envs[0], 0.0, 0.3), before[0])
    np.testing.assert_array_equal(start(envs[1], 0.1, 0.3), before[1])  # rendering again makes a new renderer
    for env in envs:
        env.close()


HASH = """
import hashlib
from safeswitch.tasks.cart_pole import CartPoleEnv
from safeswitch.tasks.rendering import Renderer
env = CartPoleEnv(render_mode="rgb_array", width=96, height=64)
simulator = env.simulator
renderer = Renderer(simulator.nominal, 64, 64, "side", fast=True)
total = hashlib.sha256()
for theta in (0.0, 0.5, 3.0):
    env.reset(seed=0, options={"initial_state": [0.2, 0.0, theta, 0.0]})
    total.update(env.render().tobytes())
    total.update(renderer.render(simulator.model, simulator.data).tobytes())
print(total.hexdigest())
"""


@pytest.mark.rendering
def test_every_process_draws_the_same_bits_with_any_number_of_threads() -> None:
    results = [run(HASH, LP_NUM_THREADS=threads) for threads in ("0", "1", "2", "2")]
    assert len(results[0].stdout.strip()) == 64, results[0].stderr
    assert {result.stdout for result in results} == {results[0].stdout}


@pytest.mark.rendering
def test_an_environment_that_has_rendered_goes_to_a_spawned_process(env: CartPoleEnv) -> None:
    picture = start(env, 0.3, 0.5)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        np.testing.assert_array_equal(pool.apply(env.render), picture)
    np.testing.assert_array_equal(env.render(), picture)


@pytest.mark.rendering
def test_vector_environments_render_what_single_ones_do() -> None:
    pictures = {}
    for mode, options in (("sync", {}), ("async", {"context": "spawn"})):
        envs = gym.make_vec("SafeSwitch/CartPole-v0", 2, mode, options, render_mode="rgb_array", width=96, height=64)
        envs.reset(seed=[3, 4])
        for _ in range(2):
            envs.step(np.full((2, 1), 0.5, np.float32))
        pictures[mode] = np.stack(envs.render())
        envs.close()
    single = CartPoleEnv(render_mode="rgb_array", width=96, height=64)
    single.reset(seed=4)
    for _ in range(2):
        single.advance([0.5])
    np.testing.assert_array_equal(pictures["sync"][1], single.render())
    np.testing.assert_array_equal(pictures["sync"], pictures["async"])
    assert (pictures["sync"][0] != pictures["sync"][1]).any()
    single.close()


@pytest.mark.rendering
def test_one_renderer_made_when_the_first_picture_is_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    make = rendering.make_context
    monkeypatch.setattr(rendering, "make_context", lambda *size: made.append(size) or make(*size))
    env = CartPoleEnv(render_mode="rgb_array", width=96, height=64)
    env.reset(seed=0)
    env.advance([0.1])
    assert made == []
    for _ in range(3):
        env.render()
        env.reset()
    assert made == [(96, 64)]
    env.close()


class Cycle:
    """Holds a renderer, and itself, so that only the garbage collector frees it."""

    def __init__(self, renderer: Renderer, close: bool) -> None:
        self.renderer, self.itself, self.close = renderer, self, close

    def __del__(self) -> None:
        if self.close:  # as gymnasium's vector environments do
            self.renderer.close()


class Interrupted:
    """An OpenGL context after whose activation the garbage collector happens to run."""

    def __init__(self, gl: Any) -> None:
        self.gl = gl

    def make_current(self) -> None:
        self.gl.make_current()
        gc.collect()


@pytest.mark.rendering
@pytest.mark.parametrize("close", [False, True])
def test_a_renderer_collected_in_the_middle_of_anothers_frame(env: CartPoleEnv, close: bool) -> None:
    start(env, 0.2, 0.4)
    model, data = env.simulator.model, env.simulator.data
    renderer, waiting = (Renderer(model, 64, 64, "side", fast=True) for _ in range(2))
    before = renderer.render(model, data)
    known = len(rendering._objects)
    Cycle(waiting, close)
    del waiting
    real, renderer._gl = renderer._gl, Interrupted(renderer._gl)
    np.testing.assert_array_equal(renderer.render(model, data), before)
    renderer._gl = real
    np.testing.assert_array_equal(renderer.render(model, data), before)
    renderer.close()
    assert len(rendering._objects) == known - 2, "both are freed now"


@pytest.mark.rendering
def test_closing_in_another_thread_harms_nobody(env: CartPoleEnv) -> None:
    start(env, 0.2, 0.4)
    model, data = env.simulator.model, env.simulator.data
    renderer, other = (Renderer(model, 64, 64, "side", fast=True) for _ in range(2))
    before, known = renderer.render(model, data), len(rendering._objects)
    thread = threading.Thread(target=other.close)
    thread.start()
    thread.join()
    with pytest.raises(RuntimeError, match="closed"):
        other.render(model, data)
    np.testing.assert_array_equal(renderer.render(model, data), before)
    renderer.close()
    assert len(rendering._objects) == known - 2, "freed by the thread that they belong to"


ENDINGS = {
    "plain": "",
    "finalizers run late": "import tempfile, weakref; weakref.finalize(tempfile, print)",
    "dm_control ends EGL early": (
        "import mujoco; from safeswitch.tasks.rendering import Renderer\n"
        "early = Renderer(mujoco.MjModel.from_xml_string("
        "'<mujoco><worldbody><camera name=\"c\"/></worldbody></mujoco>'), 8, 8, 'c')\n"
        "from dm_control import mjcf"
    ),
    "another thread": (
        "import threading; from safeswitch.tasks.cart_pole import CartPoleEnv\n"
        "other = CartPoleEnv(render_mode='rgb_array', width=8, height=8)\n"
        "thread = threading.Thread(target=lambda: (other.reset(seed=0), other.render())); thread.start(); thread.join()"
    ),
}


@pytest.mark.rendering
@pytest.mark.parametrize("first", ENDINGS.values(), ids=list(ENDINGS))
def test_renderers_that_are_left_open_end_silently(first: str) -> None:
    result = run(first + HASH)
    assert result.returncode == 0 and not result.stderr, result.stderr


@pytest.mark.rendering
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_child_is_told_instead_of_hanging() -> None:
    code = (
        "import os\nfrom safeswitch.tasks.cart_pole import CartPoleEnv\n"
        "small = dict(render_mode='rgb_array', width=64, height=48)\n"
        "env = CartPoleEnv(**small); env.reset(seed=0); before = env.render()\n"
        "child = os.fork()\n"
        "if child == 0:\n"
        "    for other in (env, CartPoleEnv(**small)):\n"
        "        other.reset(seed=0); other.advance([0.1])\n"
        "        try:\n            other.render(); os._exit(1)\n"
        "        except RuntimeError as error:\n            assert 'spawn' in str(error)\n"
        "        other.close()\n"
        "    os._exit(0)\n"
        "assert os.waitpid(child, 0)[1] == 0\n"
        "assert (env.render() == before).all()\n"
    )
    result = run(code)
    assert result.returncode == 0, result.stderr
