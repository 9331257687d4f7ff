"""Pictures: they show what happens, change nothing, and survive other renderers and missing libraries."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from numpy.typing import NDArray

from safeswitch.tasks import rendering
from safeswitch.tasks.cart_pole import CartPoleEnv
from safeswitch.tasks.rendering import Renderer

BLUE, RED = (41, 97, 158), (204, 56, 41)
"""Nominal colours of cart and bob, 0 .. 255."""


def start(env: CartPoleEnv, x: float, theta: float, **options: int) -> NDArray:
    """Picture of the environment at a given start."""
    env.reset(seed=0, options={"initial_state": [x, 0.0, theta, 0.0], **options})
    picture = env.render()
    assert picture is not None
    return picture


def centre(picture: NDArray, colour: tuple[int, int, int]) -> NDArray:
    """Mean (column, row) of the pixels whose hue is like that of `colour`."""
    direction = np.array(colour) / np.linalg.norm(colour)
    pixels = picture / np.maximum(np.linalg.norm(picture, axis=2, keepdims=True), 1)
    rows, columns = np.nonzero(pixels @ direction > 0.985)
    assert rows.size > 20
    return np.array([columns.mean(), rows.mean()])


@pytest.fixture
def env():
    env = CartPoleEnv(render_mode="rgb_array")
    yield env
    env.close()


@pytest.mark.rendering
def test_shape_and_contents(env: CartPoleEnv) -> None:
    picture = start(env, 0.0, 0.0)
    assert picture.shape == (320, 480, 3) and picture.dtype == np.uint8 and picture.flags["C_CONTIGUOUS"]
    assert picture.std() > 15
    cart, bob = centre(picture, BLUE), centre(picture, RED)
    assert abs(cart[0] - 239.5) < 3 and abs(bob[0] - 239.5) < 3
    assert bob[1] < cart[1] - 30, "upright: the bob is above the cart"


@pytest.mark.rendering
def test_picture_follows_the_state(env: CartPoleEnv) -> None:
    hanging, right, leaning = start(env, 0.0, np.pi), start(env, 1.5, 0.0), start(env, 0.0, 0.7)
    assert centre(hanging, RED)[1] > centre(hanging, BLUE)[1] + 20
    assert centre(right, BLUE)[0] > 340
    assert centre(leaning, RED)[0] > centre(leaning, BLUE)[0] + 15, "theta > 0 leans to +x, the right"


@pytest.mark.rendering
def test_both_ends_of_the_rail_are_in_the_picture(env: CartPoleEnv) -> None:
    for x in (-2.0, 2.0):
        column = centre(start(env, x, 0.0), BLUE)[0]
        assert 15 < column < 465


@pytest.mark.rendering
def test_rendering_does_not_change_the_episode(env: CartPoleEnv) -> None:
    plain = CartPoleEnv()
    env.reset(seed=4)
    plain.reset(seed=4)
    for step in range(12):
        env.render()
        env.advance([0.2 * (-1) ** step])
        plain.advance([0.2 * (-1) ** step])
        np.testing.assert_array_equal(env.snapshot(), plain.snapshot())
    before = env.snapshot()
    env.render()
    np.testing.assert_array_equal(env.snapshot(), before)


@pytest.mark.rendering
def test_same_state_same_picture(env: CartPoleEnv) -> None:
    first = start(env, 0.3, 2.0)
    start(env, -1.0, 0.4)
    np.testing.assert_array_equal(start(env, 0.3, 2.0), first)


@pytest.mark.rendering
def test_repaint_changes_cart_and_pole_and_nothing_else() -> None:
    changes = []
    for severity in (1, 3, 5):
        env = CartPoleEnv("repaint", severity, render_mode="rgb_array")
        clean, painted = start(env, 0.2, 0.5, onset=50), start(env, 0.2, 0.5, onset=0)
        difference = np.abs(clean.astype(int) - painted).sum(axis=2)
        changes.append(difference.sum())
        rows, columns = np.nonzero(difference > 6)
        assert 150 < rows.size < 3000
        assert np.ptp(rows) < 90 and np.ptp(columns) < 90
        if severity >= 3:
            assert np.percentile(difference[difference > 6], 75) > 60, "visible at a glance"
        env.close()
    assert changes[0] < changes[1] < changes[2]


@pytest.mark.rendering
def test_a_shorter_pole_is_drawn_shorter() -> None:
    env = CartPoleEnv("pole-length", 3, render_mode="rgb_array")
    clean, short = start(env, 0.0, 0.0, onset=50), start(env, 0.0, 0.0, onset=0)
    hinge = centre(clean, BLUE)[1]
    ratio = (hinge - centre(short, RED)[1]) / (hinge - centre(clean, RED)[1])
    assert ratio == pytest.approx(0.5, abs=0.06)
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


@pytest.mark.rendering
def test_fast_settings_are_small_and_do_not_leak_into_the_model() -> None:
    env = CartPoleEnv()
    env.reset(seed=0)
    simulator = env.simulator
    simulator.update_kinematics(simulator.model)
    before = (simulator.nominal.vis.global_.offwidth, simulator.nominal.vis.quality.offsamples)
    renderer = Renderer(simulator.nominal, 64, 64, "side", fast=True)
    picture = renderer.render(simulator.model, simulator.data)
    assert picture.shape == (64, 64, 3) and picture.std() > 10
    assert (simulator.nominal.vis.global_.offwidth, simulator.nominal.vis.quality.offsamples) == before
    renderer.close()
    with pytest.raises(RuntimeError, match="closed"):
        renderer.render(simulator.model, simulator.data)


@pytest.mark.rendering
def test_wrong_arguments() -> None:
    model = CartPoleEnv().simulator.nominal
    with pytest.raises(ValueError, match="unknown camera 'sid'.*side"):
        Renderer(model, 8, 8, "sid")
    with pytest.raises(ValueError, match="got width 0 and height 8"):
        Renderer(model, 0, 8, "side")


@pytest.mark.rendering
def test_probe_renders() -> None:
    works, message = rendering.probe()
    assert works and "32 x 32" in message


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


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `code` in a fresh interpreter with MUJOCO_GL and the like set anew."""
    clean = {key: value for key, value in os.environ.items() if key not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    command = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(command, env={**clean, **environment}, capture_output=True, text=True, timeout=120)


WITHOUT_EGL = """
import ctypes, ctypes.util
load, find = ctypes.CDLL.__init__, ctypes.util.find_library
def refuse(self, name, *args, **kwargs):
    if name and "EGL" in str(name):
        raise OSError(f"{name}: cannot open shared object file")
    load(self, name, *args, **kwargs)
ctypes.CDLL.__init__ = refuse
ctypes.util.find_library = lambda name: None if "EGL" in name else find(name)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="EGL exists on Linux only")
@pytest.mark.parametrize("environment", [{"MUJOCO_GL": "egl"}, {}])
def test_without_egl_physics_works_and_pictures_say_what_to_install(environment: dict[str, str]) -> None:
    code = WITHOUT_EGL + (
        "import gymnasium as gym, safeswitch\n"
        "env = gym.make('SafeSwitch/CartPole-v0', render_mode='rgb_array')\n"
        "env.reset(seed=0); env.step(env.action_space.sample())\n"
        "from safeswitch.tasks.rendering import probe; print(probe())\n"
        "env.render()\n"
    )
    result = run(code, **environment)
    assert result.returncode == 1
    assert "apt-get install -y libegl1 libgl1-mesa-dri libopengl0" in result.stderr.splitlines()[-1]
    assert result.stdout.startswith("(False") and rendering.REMEDY in result.stdout


@pytest.mark.rendering
def test_backend_is_chosen_without_any_variable_and_after_mujoco() -> None:
    code = (
        "import sys\n{first}import gymnasium as gym, safeswitch\n"
        "env = gym.make('SafeSwitch/CartPole-v0', render_mode='rgb_array')\n"
        "env.reset(seed=0); print(env.render().std() > 15)\n"
    )
    for first in ("", "import mujoco\n"):
        result = run(code.format(first=first))
        assert result.stdout.strip() == "True", result.stderr
        assert not result.stderr, result.stderr


def test_other_backends_are_the_users_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    for value in ("osmesa", "glfw", "disabled"):
        monkeypatch.setenv("MUJOCO_GL", value)
        assert rendering.choose_backend() == value == os.environ["MUJOCO_GL"]


def test_egl_is_never_set_on_other_systems(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    assert rendering.choose_backend() == "" and "MUJOCO_GL" not in os.environ
    assert not rendering.has_egl()
