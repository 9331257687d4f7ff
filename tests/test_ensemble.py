"""The ensemble's disagreement, and what signals share that are made in one context."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safeswitch.protocols import Prediction, Signal, SignalContext
from safeswitch_baselines.signals import Ensemble, make_signal


class Drifting:
    """A learner with a memory: its action is its gain times the sum of what it saw in this episode."""

    def __init__(self, gain: float) -> None:
        self.gain, self.total, self.seeds, self.steps = gain, 0.0, [], []  # type: ignore[var-annotated]

    def reset(self, seed: int) -> None:
        self.total, self.steps = 0.0, []
        self.seeds.append(seed)

    def predict(self, observation: Any, step: int) -> Prediction:
        self.total += float(observation[0])
        self.steps.append(step)
        return Prediction(np.array([self.gain * self.total, self.gain]), np.zeros(2), np.zeros(2))


def drive(signals: list[Signal], steps: int, own: float = 1.0) -> list[list[float]]:
    """Values of each signal over an episode whose observations are all one."""
    learner = Drifting(own)
    for signal in signals:
        signal.reset()
    seen = []
    for step in range(steps):
        prediction = learner.predict(np.ones(1), step)
        seen.append([signal.update(np.ones(1), prediction, None) for signal in signals])
    return [list(row) for row in zip(*seen, strict=True)]


def test_an_ensemble_that_agrees_is_silent() -> None:
    assert drive([Ensemble([Drifting(1.0) for _ in range(4)])], 5) == [[0.0] * 5]


def test_the_ensemble_is_the_population_deviation_of_its_actions() -> None:
    gains = [0.3, -0.2, 0.7, 0.1]
    found = drive([Ensemble([Drifting(gain) for gain in gains])], 4)[0]
    spread = np.std([1.0, *gains])
    np.testing.assert_allclose(found, [np.hypot(spread * step, spread) for step in (1, 2, 3, 4)])
    for order in ([3, 1, 0, 2], [2, 3, 1, 0]):
        assert drive([Ensemble([Drifting(gains[index]) for index in order])], 4)[0] == found


def test_members_start_anew_with_every_episode_and_count_their_own_steps() -> None:
    member = Drifting(0.5)
    signal = Ensemble([member])
    assert drive([signal], 3) == drive([signal], 3)
    assert set(member.seeds) == {0} and member.steps == [0, 1, 2]


def test_signals_of_one_context_ask_the_members_once_a_step() -> None:
    member = Drifting(0.5)
    context = SignalContext(members=[member])
    names = ["ensemble-mean3", "ensemble", "ensemble-max2"]
    together = drive([make_signal(name, context) for name in names], 6)
    assert member.steps == list(range(6)), "each saw every observation once"
    apart = [drive([make_signal(name, SignalContext(members=[Drifting(0.5)]))], 6)[0] for name in names]
    assert together == apart


@pytest.mark.parametrize(
    ("name", "context", "message"),
    [
        ("mahalanobis", None, "signal 'mahalanobis' is fitted to a learner's training features"),
        ("rnd-mean3", SignalContext(fits={"knn": {}}), "signal 'rnd' is fitted to a learner's training features"),
        ("ensemble", None, "signal 'ensemble' needs the learners of other seeds"),
        ("ensemble-max5", SignalContext(), "signal 'ensemble' needs the learners of other seeds"),
        ("mahalanobi-mean3", SignalContext(), "unknown signal 'mahalanobi'; valid, nearest first: mahalanobis"),
    ],
)
def test_what_is_missing_is_named(name: str, context: SignalContext | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_signal(name, context)
