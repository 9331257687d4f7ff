"""The same states seen without the disturbance: what signals are compared with on images."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from safeswitch.handover.clean import clean_traces
from safeswitch.handover.table import HandoverTable, record_table
from safeswitch.protocols import Array, Prediction
from safeswitch.tasks.cart_pole_image import CartPoleImageEnv

pytestmark = pytest.mark.rendering

SEEDS = [3, 4, 5]


class Brightness:
    """A learner with a memory: it pushes to the side on which the last two frames are darker."""

    def reset(self, seed: int) -> None:
        self._before = 0.0

    def predict(self, observation: NDArray[Any], step: int) -> Prediction:
        half = observation.astype(float).mean(axis=(0, 2))
        side = float(half[:32].mean() - half[32:].mean()) / 255.0
        action = np.array([0.5 * (side + self._before)])
        self._before = side
        return Prediction(action, action**2, np.zeros(1), observation.ravel()[:8].astype(np.float32))


class Seen:
    """Signals with a memory too: the mean of all pixels, minus the one before, and the executed action before."""

    id = "seen"

    def reset(self) -> None:
        self._before = 0.0

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        value = float(observation.mean())
        change = value - self._before + (0.0 if previous_action is None else 100.0 * float(previous_action[0]))
        self._before = value
        return change + float(prediction.epistemic_var[0])


def recorded(name: str | None, severity: int = 3) -> tuple[CartPoleImageEnv, HandoverTable]:
    """A table of three episodes, and the environment that it is from."""
    env = CartPoleImageEnv(name, severity)
    return env, record_table(env, Brightness(), [Seen()], env.make_expert(), SEEDS)


def test_without_a_disturbance_the_clean_view_is_the_recorded_one() -> None:
    env, table = recorded(None)
    traces, visible = clean_traces(env, Brightness(), [Seen()], table)
    np.testing.assert_array_equal(traces["seen"], table.signals["seen"])
    assert not visible.any()


@pytest.mark.parametrize("name", ["object", "pixel-noise", "lighting"])
def test_the_two_views_part_at_the_onset(name: str) -> None:
    env, table = recorded(name, 5)
    traces, visible = clean_traces(env, Brightness(), [Seen()], table)
    for episode, onset in enumerate(table.onset):
        np.testing.assert_array_equal(traces["seen"][episode, :onset], table.signals["seen"][episode, :onset])
        assert not visible[episode, :onset].any()
        length = table.length[episode]
        if length > onset:
            assert visible[episode, onset:length].mean() > 0.5
            assert traces["seen"][episode, onset] != table.signals["seen"][episode, onset]
        assert np.isnan(traces["seen"][episode, length:]).all() and not visible[episode, length:].any()


def test_the_clean_view_is_the_undisturbed_task_driven_by_the_recorded_actions() -> None:
    """The states are the disturbed episode's, and only visual objects make those reproducible without it."""
    env, table = recorded("object", 5)
    traces, _ = clean_traces(env, Brightness(), [Seen()], table)
    twin, signal, learner = CartPoleImageEnv(), Seen(), Brightness()
    env.reset(seed=SEEDS[0])
    twin.reset(seed=SEEDS[0])
    learner.reset(SEEDS[0])
    signal.reset()
    previous = None
    assert table.snapshots is not None
    for step in range(int(table.length[0])):
        observation = twin.observe()
        value = signal.update(observation, learner.predict(observation, step), previous)
        assert value == traces["seen"][0, step]
        env.restore(table.snapshots[0, step + 1])
        previous = env.simulator.data.ctrl.copy()
        twin.advance(previous)


def test_a_table_without_snapshots_is_refused() -> None:
    env, table = recorded("object")
    with pytest.raises(ValueError, match="snapshots"):
        clean_traces(env, Brightness(), [Seen()], table.take(np.array([0])))
