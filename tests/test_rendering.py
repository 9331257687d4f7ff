"""Pictures: they show what happens, change nothing, and cost little when they are fast."""

from __future__ import annotations

import os

import mujoco
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


BALL = """
<mujoco><visual><quality offsamples="4" shadowsize="512"/></visual><worldbody>
<light pos="0 0 3"/><camera name="top" pos="0 0 3" fovy="40"/><geom type="sphere" size=".9" rgba="1 0 0 1"/>
</worldbody></mujoco>
"""


@pytest.mark.rendering
def test_fast_is_everything_that_saves_time() -> None:
    model = mujoco.MjModel.from_xml_string(BALL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    areas = {}
    for fast in (False, True):
        renderer = Renderer(model, 160, 120, "top", fast=fast)
        scene, context = renderer._scene, renderer._context
        for flag in ("SHADOW", "REFLECTION", "SKYBOX", "HAZE"):
            assert scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] == (not fast), flag
        assert (context.offWidth, context.offHeight) == (160, 120)
        assert (context.offSamples == 0) == (context.shadowSize == 0) == fast
        areas[fast] = (renderer.render(model, data)[:, :, 0] > 50).sum()
        renderer.close()
    assert 0.75 < areas[True] / areas[False] < 0.95, "coarse: from its pole the ball looks like an octagon"


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
def test_what_draws_is_known_and_asking_disturbs_nobody(env: CartPoleEnv) -> None:
    before = start(env, 0.2, 0.4)
    found = rendering.describe_renderer()
    assert found.backend == (os.environ.get("MUJOCO_GL") or "system OpenGL")
    assert found.renderer and found.vendor and found.version[0].isdigit()
    assert found.software == ("llvmpipe" in found.renderer or "softpipe" in found.renderer)
    np.testing.assert_array_equal(env.render(), before)
