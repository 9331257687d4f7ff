"""The benchmark of pictures: the alternatives draw the same thing, and ratios come from the same round."""

from __future__ import annotations

import time
from contextlib import ExitStack

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

from safeswitch import perf_rendering
from safeswitch.protocols import Prediction
from safeswitch.tasks.cart_pole import CartPoleEnv


@pytest.mark.rendering
def test_every_alternative_is_timed_and_compared() -> None:
    results = perf_rendering.rendering_benchmark(repeats=3, frames=8)
    assert results["model"] in gym.registry and results["drawn by"]
    rates = {name: value for name, value in results.items() if name.endswith("[frames/s]")}
    expected = {"bare default [frames/s]", "bare fast [frames/s]", "fast [frames/s]"}
    assert expected <= set(rates) and all(value > 1 for value in rates.values())
    assert ("environment [frames/s]" in rates) == (results["model"] == perf_rendering.ENV_IDS[0])
    # A factor of ten and more on the processor; whatever draws, leaving work out is not slower.
    assert results["fast / bare default"] > 1
    # The same settings by another hand; a handful of frames on a busy machine is off by a factor of four now and then.
    assert 0.1 < results["fast / bare fast"] < 10


@pytest.mark.rendering
def test_the_bare_loops_draw_what_ours_does() -> None:
    env = CartPoleEnv()
    with ExitStack() as stack:
        ways = perf_rendering.drawings(env, stack)
        for data in perf_rendering.visited(env, 3):
            pictures = {name: np.asarray(draw(data)) for name, draw in ways.items()}
            np.testing.assert_array_equal(pictures["fast"], pictures["bare fast"])
            assert pictures["bare default"].shape == (64, 64, 3)
            # The same scene, with sky and shadows: the cart is where it was.
            blue = [picture[:, :, 2] > picture[:, :, 0] + 60.0 for picture in pictures.values()]
            assert (blue[0] & blue[1]).sum() > 0.5 * blue[1].sum() > 0
    assert env.simulator.nominal.vis.quality.offsamples == 4, "the model is as it was"


def test_states_that_are_drawn_differ() -> None:
    env = CartPoleEnv()
    states = perf_rendering.visited(env, 4)
    assert len({data.qpos.tobytes() for data in states}) == 4


def test_steps_are_counted_over_the_end_of_an_episode() -> None:
    env = CartPoleEnv(horizon=5)
    assert perf_rendering.steps_per_second(env, 12) > 10
    assert env.step_index == 2


class Slow:
    """Takes some milliseconds to decide, and notes what it was shown."""

    def __init__(self, seconds: float) -> None:
        self.seconds, self.shown, self.resets = seconds, [], 0  # type: ignore[var-annotated]

    def reset(self, seed: int) -> None:
        self.resets += 1

    def predict(self, observation: NDArray, step: int) -> Prediction:
        self.shown.append((step, int(observation[0, 0, 0])))
        time.sleep(self.seconds)
        return Prediction(np.zeros(1), np.zeros(1), np.zeros(1))


def test_decisions_are_timed_per_frame_and_compared_with_the_first() -> None:
    frames = np.arange(4, dtype=np.uint8)[:, None, None, None] * np.ones((1, 64, 64, 3), np.uint8)
    learners = {"shared": Slow(0.005), "everywhere": Slow(0.02)}
    results = perf_rendering.decision_ms(learners, frames, repeats=3)
    assert set(results) == {"shared [ms]", "everywhere [ms]", "everywhere / shared"}
    assert 5 <= results["shared [ms]"] < results["everywhere [ms]"]
    assert 1.5 < results["everywhere / shared"] < 4.5
    assert learners["shared"].shown[-4:] == [(0, 0), (1, 1), (2, 2), (3, 3)]
    assert learners["shared"].resets == 4  # three rounds and one that warms up
    with pytest.raises(ValueError, match="got 2 and 0"):
        perf_rendering.decision_ms(learners, frames[:0])


@pytest.mark.rendering
def test_sharing_the_trunk_pays() -> None:
    results = perf_rendering.decision_benchmark()
    assert results["dropout everywhere / trunk shared"] > 1, "thirty passes through the trunk instead of one"
