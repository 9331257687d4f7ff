"""Disturbances change what they say, when they say it, and leave no trace."""

from __future__ import annotations

import math
from functools import cache

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chisquare

from safeswitch.tasks import models
from safeswitch.tasks.cart_pole import CartPoleConfig, CartPoleEnv
from safeswitch.tasks.disturbances import (
    DISTURBANCES,
    SEVERITIES,
    Push,
    check_severity,
    make_disturbance,
    offered,
)

NAMES = offered("cart-pole")
MODEL_ARRAYS = [
    name for name in dir(mujoco.MjModel) if name.startswith(("body_", "dof_", "geom_", "mat_", "actuator_", "jnt_"))
]


def actions(seed: int, count: int = 100) -> NDArray:
    """Random actions (count, 1), gentle enough to stay on the rail for a while."""
    return 0.4 * np.random.default_rng(seed).uniform(-1, 1, (count, 1))


def footprint(env: CartPoleEnv, action: NDArray) -> tuple[bytes | float, ...]:
    """Step, and everything that comes of it, to the last bit."""
    observation, reward, terminated, truncated, _ = env.step(action)
    arrays = (env.snapshot(), observation, env.parameters, env.state)
    return (*(array.tobytes() for array in arrays), float(reward), terminated, truncated, env.is_success)


@cache
def pair(name: str, severity: int) -> tuple[CartPoleEnv, CartPoleEnv]:
    """Two environments with the same disturbance: making them takes longer than an episode."""
    return CartPoleEnv(name, severity), CartPoleEnv(name, severity)


@cache
def undisturbed() -> CartPoleEnv:
    """The undisturbed twin."""
    return CartPoleEnv()


def arrays(model: mujoco.MjModel) -> dict[str, NDArray]:
    """Copies of all arrays that a disturbance could touch."""
    return {name: np.array(getattr(model, name)) for name in MODEL_ARRAYS}


def test_registry_offers_what_the_benchmark_needs() -> None:
    kinds = {DISTURBANCES[name].kind for name in NAMES}
    assert kinds == {"dynamics", "actuation", "sensing", "appearance"}
    assert any(DISTURBANCES[name].benign for name in NAMES)
    assert NAMES[0] == "cart-mass"


def test_the_papers_numbers() -> None:
    env = CartPoleEnv("cart-mass", severity=3)
    env.reset(seed=0, options={"onset": 2})
    before = env.parameters
    env.advance([0.0])
    np.testing.assert_array_equal(env.parameters, before)
    env.advance([0.0])
    assert (before[0], env.parameters[0]) == (1.0, 0.2)
    np.testing.assert_array_equal(env.parameters[1:], before[1:])


@pytest.mark.parametrize("name", NAMES)
def test_description_names_the_value(name: str) -> None:
    cls = DISTURBANCES[name]
    assert cls.__doc__
    texts = [cls.describe(severity) for severity in SEVERITIES]
    assert len(set(texts)) == 5
    for text, level in zip(texts, cls.levels, strict=True):
        assert f"{level:g}" in text


def test_unknown_names_list_the_nearest_first() -> None:
    with pytest.raises(
        ValueError, match=r"unknown disturbance of cart-pole 'cartmass'; valid, nearest first: cart-mass"
    ):
        make_disturbance("cartmass", 3, "cart-pole")
    with pytest.raises(ValueError, match="nearest first: pole-length"):
        CartPoleEnv("pole_lenght")
    with pytest.raises(ValueError, match="there are none"):
        make_disturbance("push", 3, "no-such-task")


@pytest.mark.parametrize("severity", [0, 6, -1, 2.5, True, "3", None])
def test_severity_must_be_one_to_five(severity: object) -> None:
    with pytest.raises(ValueError, match="severity must be an integer from 1 to 5"):
        CartPoleEnv("push", severity)  # type: ignore[arg-type]


def test_severity_may_come_from_numpy() -> None:
    assert check_severity(np.int64(4)) == 4  # type: ignore[arg-type]


def effect(name: str, severity: int) -> float:
    """How far the disturbed episode is from its undisturbed twin right after the onset."""
    options = {"initial_state": [0.1, 0.3, 2.4, -0.5], "onset": 0}
    env, twin = CartPoleEnv(name, severity), CartPoleEnv()
    env.reset(seed=3, options=options)
    twin.reset(seed=3, options=options)
    kind = DISTURBANCES[name].kind
    if kind == "sensing":
        return float(np.abs(env.observe() - twin.observe()).sum())
    if kind == "appearance":
        return float(np.abs(env.simulator.model.mat_rgba - twin.simulator.model.mat_rgba).sum())
    for _ in range(2):
        env.advance([0.6])
        twin.advance([0.6])
    return float(np.abs(env.state - twin.state).sum())


@pytest.mark.parametrize("name", NAMES)
def test_effect_grows_with_severity(name: str) -> None:
    effects = [effect(name, severity) for severity in SEVERITIES]
    assert effects[0] > 1e-3
    assert (np.diff(effects) > 0).all(), effects


@pytest.mark.parametrize("name", NAMES)
@given(seed=st.integers(0, 10**6))
def test_the_twin_is_identical_until_the_onset(name: str, seed: int) -> None:
    env, twin = pair(name, 5)[0], undisturbed()
    np.testing.assert_array_equal(env.reset(seed=seed)[0], twin.reset(seed=seed)[0])
    assert env.onset is not None and twin.onset is None
    for noise in actions(seed)[: env.onset - 1]:
        x, x_dot, *_ = env.state
        action = noise - 0.4 * (x + x_dot)  # stay on the rail
        env.advance(action)
        twin.advance(action)
        np.testing.assert_array_equal(env.snapshot(), twin.snapshot())
        np.testing.assert_array_equal(env.observe(), twin.observe())
        np.testing.assert_array_equal(env.parameters, twin.parameters)
        assert not env.disturbed
    # The disturbance sets in before the observation of step t0, and moves nothing at that moment.
    env.advance([0.1])
    twin.advance([0.1])
    assert env.disturbed and env.step_index == env.onset
    np.testing.assert_array_equal(env.snapshot(), twin.snapshot())
    np.testing.assert_array_equal(env.observe(clean=True), twin.observe())


@pytest.mark.parametrize("name", NAMES)
@given(seed=st.integers(0, 10**6), step=st.integers(0, 99), onset=st.integers(0, 60), severity=st.integers(1, 5))
def test_restored_episodes_continue_bit_for_bit(name: str, seed: int, step: int, onset: int, severity: int) -> None:
    options = {"onset": onset}
    env, fresh = pair(name, severity)
    env.reset(seed=seed, options=options)
    commands = actions(seed)
    snapshot, rest = None, []
    for index, action in enumerate(commands):
        if env.done:
            break
        if index == step:
            snapshot = env.snapshot()
        mark = footprint(env, action)
        if snapshot is not None:
            rest.append(mark)
    if snapshot is None:  # failed before that step
        return
    fresh.reset(seed=seed, options=options)
    for again in (env, fresh):  # the same environment, gone back, and another one
        again.restore(snapshot)
        assert again.step_index == step and again.disturbed == (step >= onset)
        assert again.snapshot().tobytes() == snapshot.tobytes()
        assert [footprint(again, action) for action in commands[step : step + len(rest)]] == rest


@pytest.mark.parametrize("name", NAMES)
def test_the_nominal_model_stays_pristine(name: str) -> None:
    env = CartPoleEnv(name, 4)
    pristine = arrays(CartPoleEnv().simulator.nominal)
    env.reset(seed=8, options={"onset": 3})
    early = env.snapshot()
    for action in actions(8)[:10]:
        env.advance(action)
    env.restore(early)
    assert env.simulator.model is env.simulator.nominal
    for key, value in arrays(env.simulator.model).items():
        np.testing.assert_array_equal(value, pristine[key], err_msg=key)
    disturbed = arrays(env.simulator.disturbed)
    env.reset(seed=8, options={"onset": 3})  # twice in a row gives the same model: nothing accumulates
    for key, value in arrays(env.simulator.disturbed).items():
        np.testing.assert_array_equal(value, disturbed[key], err_msg=key)


@pytest.mark.parametrize(
    ("name", "change"), [("cart-mass", {"cart_mass": 0.2}), ("pole-length", {"pole_length": 0.25})]
)
def test_inertial_disturbances_equal_a_model_compiled_that_way(name: str, change: dict[str, float]) -> None:
    """Every derived constant as the compiler computes it: this is what `mj_setConst` is for."""
    env = CartPoleEnv(name, 3)
    env.reset(seed=0, options={"onset": 0})
    got, compiled = env.simulator.model, models.cart_pole(CartPoleConfig(**change))
    fields = ("body_mass", "body_subtreemass", "body_ipos", "dof_M0", "dof_invweight0", "geom_pos", "geom_size")
    for field in fields:
        np.testing.assert_allclose(getattr(got, field), getattr(compiled, field), rtol=1e-12, err_msg=field)
    cart, pole = got.body("cart").id, got.body("pole").id
    np.testing.assert_allclose(got.body_inertia[pole], compiled.body_inertia[pole])
    nominal = models.cart_pole(CartPoleConfig())
    ratio = got.body_mass[cart] / nominal.body_mass[cart]
    np.testing.assert_allclose(got.body_inertia[cart], ratio * nominal.body_inertia[cart])

    plain = CartPoleEnv(**change)
    plain.reset(seed=0)
    for action in actions(0)[:30]:
        env.advance(action)
        plain.advance(action)
    np.testing.assert_allclose(env.state, plain.state, rtol=1e-9)


def test_push_lasts_three_steps_and_is_an_impulse() -> None:
    env, twin = CartPoleEnv("push", 3), CartPoleEnv()
    start = {"initial_state": [0.0, 0.0, math.pi, 0.0]}
    env.reset(seed=0, options={**start, "onset": 4})
    twin.reset(seed=0, options=start)
    gaps = []
    for _ in range(12):
        env.advance([0.0])
        twin.advance([0.0])
        gaps.append(float(env.simulator.data.qfrc_applied[0]))
    force = Push.levels[2]
    assert np.abs(gaps).tolist() == [0.0] * 4 + [force] * 3 + [0.0] * 5
    # Momentum along the rail: (M + m) x_dot + m l cos(theta) theta_dot, up to friction.
    M, m, length = env.parameters[:3]
    _, v, theta, w = env.state
    momentum = (M + m) * v + m * length * math.cos(theta) * w
    assert abs(momentum) == pytest.approx(force * 3 * 0.06, rel=0.05)


def test_pushes_come_from_both_sides() -> None:
    signs = set()
    for seed in range(12):
        env = CartPoleEnv("push")
        env.reset(seed=seed, options={"onset": 0})
        env.advance([0.0])
        signs.add(float(np.sign(env.simulator.data.qfrc_applied[0])))
    assert signs == {-1.0, 1.0}


@pytest.mark.parametrize("name", ["sensor-bias", "sensor-noise"])
def test_sensing_leaves_the_state_alone(name: str) -> None:
    env, twin = CartPoleEnv(name, 5), CartPoleEnv()
    env.reset(seed=2, options={"onset": 0})
    twin.reset(seed=2)
    seen = []
    for action in actions(2)[:40]:
        observation, *_, info = env.step(action)
        clean, *_, twin_info = twin.step(action)
        np.testing.assert_array_equal(info["state"], twin_info["state"])
        np.testing.assert_array_equal(env.observe(clean=True), clean)
        np.testing.assert_array_equal(env.observe(), observation)  # looking twice changes nothing
        difference = observation.astype(float) - clean
        seen.append([*difference[:2], math.remainder(difference[2], math.tau), difference[3]])
    seen_array = np.array(seen)
    if name == "sensor-bias":
        np.testing.assert_allclose(np.abs(seen_array), np.tile([0, 0, 0.4, 0], (40, 1)), atol=1e-6)
    else:
        np.testing.assert_allclose(seen_array.std(axis=0), 0.2 * np.array([0.5, 2.0, 1.0, 4.0]), rtol=0.4)


def test_onsets_are_uniform_on_their_range() -> None:
    env = CartPoleEnv("repaint")
    onsets = np.array([env.reset(seed=seed)[1]["onset"] for seed in range(1500)])
    assert (onsets.min(), onsets.max()) == (8, 48)
    counts = np.histogram(onsets, bins=41, range=(7.5, 48.5))[0]
    assert chisquare(counts).pvalue > 0.01


def test_onset_is_the_same_for_every_disturbance() -> None:
    onsets = set()
    for name in NAMES:
        env = CartPoleEnv(name)
        env.reset(seed=77)
        onsets.add(env.onset)
    assert len(onsets) == 1


def test_snapshots_of_other_episodes_are_refused() -> None:
    env = CartPoleEnv("cart-mass")
    env.reset(seed=1)
    snapshot = env.snapshot()
    env.reset(seed=2)
    with pytest.raises(ValueError, match=r"reset\(seed=1\)"):
        env.restore(snapshot)
    with pytest.raises(ValueError, match="has shape"):
        env.restore(snapshot[:-1])
    with pytest.raises(ValueError, match=r"reset\(seed=1\)"):
        CartPoleEnv("cart-mass").restore(snapshot)
