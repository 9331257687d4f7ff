"""The same states seen with a disturbance: what signals are judged by on images."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from safeswitch.handover.shown import JUDGED, shown_traces
from safeswitch.handover.table import HandoverTable, record_table
from safeswitch.protocols import Array, Prediction
from safeswitch.tasks.cart_pole_image import CartPoleImageEnv
from safeswitch.tasks.rally_car_image import RallyCarImageEnv

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


class Straight:
    """Steers nowhere."""

    def reset(self, seed: int) -> None:
        pass

    def predict(self, observation: NDArray[Any], step: int) -> Prediction:
        return Prediction(np.zeros(1), np.zeros(1), np.zeros(1))


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


def recorded(name: str | None = None) -> HandoverTable:
    """A table of three episodes."""
    env = CartPoleImageEnv(name)
    return record_table(env, Brightness(), [Seen()], env.make_expert(), SEEDS)


def test_before_the_onset_it_is_the_recorded_signal_and_afterwards_it_is_not() -> None:
    table = recorded()
    for name in ("object", "pixel-noise", "lighting"):
        env = CartPoleImageEnv(name, 5)
        shown = shown_traces(env, Brightness(), [Seen()], table)
        traces, visible = shown.traces, shown.visible
        assert np.isnan(shown.distance).all() and np.array_equal(shown.judged, visible)
        for episode, seed in enumerate(table.seeds):
            env.reset(seed=int(seed))
            onset, length = env.onset, int(table.length[episode])
            np.testing.assert_array_equal(traces["seen"][episode, :onset], table.signals["seen"][episode, :onset])
            assert not visible[episode, :onset].any()
            if length > onset:
                assert visible[episode, onset:length].mean() > 0.5
                assert traces["seen"][episode, onset] != table.signals["seen"][episode, onset]
            assert np.isnan(traces["seen"][episode, length:]).all() and not visible[episode, length:].any()


def test_it_is_what_the_learner_would_say_if_it_did_not_react() -> None:
    """Driven by the recorded actions, the disturbed task visits the undisturbed states."""
    table = recorded()
    traces = shown_traces(CartPoleImageEnv("object", 5), Brightness(), [Seen()], table).traces
    env, twin, signal, learner = CartPoleImageEnv("object", 5), CartPoleImageEnv(), Seen(), Brightness()
    for each in (env, twin):
        each.reset(seed=SEEDS[0])
    learner.reset(SEEDS[0])
    signal.reset()
    previous = None
    assert table.snapshots is not None
    for step in range(int(table.length[0])):
        observation = env.observe()
        value = signal.update(observation, learner.predict(observation, step), previous)
        assert value == traces["seen"][0, step]
        twin.restore(table.snapshots[0, step + 1])
        previous = twin.simulator.data.ctrl.copy()
        env.advance(previous)
        np.testing.assert_array_equal(env.state, twin.state)


def test_tables_that_hold_no_undisturbed_states_are_refused() -> None:
    env = CartPoleImageEnv("object")
    with pytest.raises(ValueError, match="snapshots"):
        shown_traces(env, Brightness(), [Seen()], recorded().take(np.array([0])))
    with pytest.raises(ValueError, match="disturbed ones"):
        shown_traces(env, Brightness(), [Seen()], recorded("object"))


def test_an_obstacle_is_shown_on_states_of_undisturbed_episodes() -> None:
    """A placed disturbance: its kind, its distance, and frames judged only where it is neither near nor far."""
    plain = RallyCarImageEnv(horizon=60)
    table = record_table(plain, Straight(), [Seen()], plain.make_expert(), SEEDS[:2])
    shown = shown_traces(RallyCarImageEnv("obstacle", 3, horizon=60), Straight(), [Seen()], table)
    assert set(shown.kinds) <= {"box", "barrel", "ball", "slab"}
    assert np.all(np.diff(shown.distance[0, : int(table.length[0])]) < 0.0)  # it comes nearer
    assert not (shown.judged & ~shown.visible).any()
    judged = shown.distance[shown.judged]
    assert ((judged >= JUDGED[0]) & (judged <= JUDGED[1])).all()
    before = np.cumsum(shown.visible, axis=1) == 0
    np.testing.assert_array_equal(shown.traces["seen"][before], table.signals["seen"][before])


def test_outcomes_up_to_the_onset_are_those_of_the_undisturbed_twin() -> None:
    twin = recorded().complete()
    own, shared = recorded("object").complete(), recorded("object").share(twin)
    steps = np.arange(own.horizon + 1)
    before = (steps <= own.onset[:, None]) & (steps < own.length[:, None])
    np.testing.assert_array_equal(shared.known() != -1, before | (steps >= own.length[:, None]))
    np.testing.assert_array_equal(shared.known()[before], own.known()[before])
    np.testing.assert_array_equal(shared.complete().known(), own.known())


def test_outcomes_are_not_shared_with_another_table() -> None:
    with pytest.raises(ValueError, match="undisturbed twin"):
        recorded("object").share(recorded("object"))
