"""The one control loop, with drivers that follow a script: who drives which step, who is asked, who is reset."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pytest

from safeswitch.handover.episode import Episode, NeverSwitch, arming_step, continue_with_expert, run_episode
from safeswitch.protocols import Array, Driver, Prediction
from safeswitch.tasks.cart_pole import CartPoleEnv
from safeswitch_baselines.signals import Epistemic, Total, make_signal

SEED = 3


class ScriptedLearner:
    """Pushes to and fro; its variances are a function of (seed, step)."""

    def __init__(self, action: float | None = None) -> None:
        self.action = action
        self.steps: list[int] = []

    def reset(self, seed: int) -> None:
        self.seed = seed
        self.steps.clear()

    def predict(self, observation: Any, step: int) -> Prediction:
        self.steps.append(step)
        action = 0.2 * np.sin(step) if self.action is None else self.action
        variances = np.random.default_rng([self.seed, step]).random(2)
        return Prediction(np.array([action]), variances[:1], variances[1:])


class ScriptedRule:
    """The expert drives the steps `driven`; `at_arming` is the answer of `arm`. Every call is noted."""

    def __init__(self, driven: Iterable[int] = (), at_arming: Any = Driver.LEARNER) -> None:
        self.driven, self.at_arming = set(driven), at_arming
        self.calls: list[tuple[str, int]] = []
        self.signals: list[dict[str, float]] = []

    def reset(self, seed: int) -> None:
        self.calls.append(("reset", seed))

    def arm(self, step: int) -> Driver:
        self.calls.append(("arm", step))
        return self.at_arming

    def update(self, step: int, signals: Mapping[str, float]) -> Driver:
        self.calls.append(("update", step))
        self.signals.append(dict(signals))
        return Driver(step + 1 in self.driven)


class ScriptedExpert:
    """Holds still; notes when it was reset and asked."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def reset(self) -> None:
        self.calls.append("reset")

    def action(self, state: Array, parameters: Array) -> Array:
        self.calls.append("action")
        return np.zeros(1)


class Recorder:
    """A signal that notes what it was shown."""

    id = "recorder"

    def __init__(self) -> None:
        self.resets = 0
        self.previous: list[Array | None] = []

    def reset(self) -> None:
        self.resets += 1
        self.previous.clear()

    def update(self, observation: Any, prediction: Prediction, previous_action: Array | None) -> float:
        self.previous.append(None if previous_action is None else previous_action.copy())
        return float(len(self.previous))


@pytest.fixture(scope="module")
def env() -> CartPoleEnv:
    return CartPoleEnv()


@pytest.fixture(scope="module")
def heavy() -> CartPoleEnv:
    return CartPoleEnv(disturbance="cart-mass", severity=3)


def drive(env: CartPoleEnv, rule: Any, arming: Any = "start", **options: Any) -> Episode:
    arguments = {"learner": ScriptedLearner(), "signals": [Total()], "expert": ScriptedExpert(), "seed": SEED}
    return run_episode(env, rule=rule, arming=arming, **{**arguments, **options})


def expert_steps(episode: Episode) -> list[int]:
    return np.flatnonzero(episode.driver == Driver.EXPERT).tolist()


def test_an_alarm_hands_over_from_the_next_step(env) -> None:
    rule = ScriptedRule(range(31, 100))  # alarms at step 30
    episode = drive(env, rule)
    assert expert_steps(episode) == list(range(31, env.horizon))
    assert (episode.handover, episode.learner_steps, episode.armed_learner_steps, episode.handovers) == (31, 31, 31, 1)
    np.testing.assert_array_equal(episode.actions[31:], 0.0)
    np.testing.assert_array_equal(episode.actions[:31, 0], 0.2 * np.sin(np.arange(31)))


def test_an_alarm_at_the_last_step_comes_too_late(env) -> None:
    episode = drive(env, ScriptedRule([env.horizon]))
    assert (episode.handover, episode.handovers, episode.learner_steps) == (env.horizon, 0, env.horizon)


@pytest.mark.parametrize("arming", ["onset", "start"])
def test_arming_may_hand_over_at_the_arming_step_itself(heavy, arming) -> None:
    episode = drive(heavy, ScriptedRule(range(100), at_arming=Driver.EXPERT), arming)
    assert episode.arming_step == episode.handover == (0 if arming == "start" else episode.onset)
    assert episode.armed_learner_steps == 0 and episode.learner_steps == episode.arming_step
    assert episode.handovers == 1


@pytest.mark.parametrize("arming", ["onset", "start"])
def test_a_rule_is_asked_only_once_it_is_armed_and_then_at_every_step(heavy, arming) -> None:
    rule, learner, signal = ScriptedRule(range(40, 50)), ScriptedLearner(), Recorder()
    episode = drive(heavy, rule, arming, learner=learner, signals=[signal])
    start = episode.arming_step
    updates = [("update", step) for step in range(start, episode.length)]
    assert rule.calls == [("reset", SEED), ("arm", start), *updates]
    assert learner.steps == list(range(episode.length)), "the learner predicts whoever drives, armed or not"
    assert len(signal.previous) == episode.length
    assert [each["recorder"] for each in rule.signals] == [step + 1.0 for step in range(start, episode.length)]


def test_undisturbed_episodes_are_never_armed_under_onset(env) -> None:
    rule = ScriptedRule(range(100), at_arming=Driver.EXPERT)
    episode = drive(env, rule, "onset", expert=None)
    assert rule.calls == [("reset", SEED)]
    assert (episode.onset, episode.arming_step, episode.handover) == (-1, env.horizon, env.horizon)
    assert episode.armed_learner_steps == 0 and episode.learner_steps == episode.length


def test_give_back_counts_every_handover_and_resets_the_expert_at_each(env) -> None:
    driven = [*range(10, 15), *range(30, 33), 50]
    expert = ScriptedExpert()
    episode = drive(env, ScriptedRule(driven), expert=expert)
    assert expert_steps(episode) == driven
    assert (episode.handovers, episode.handover) == (3, 10)
    assert episode.learner_steps == episode.length - len(driven)
    bursts = [["reset", *["action"] * length] for length in (5, 3, 1)]
    assert expert.calls == [call for burst in bursts for call in burst]


def test_after_a_takeover_the_episode_is_the_experts_continuation_from_that_state(heavy) -> None:
    for seed, handover in ((0, 20), (1, 45)):
        stale = heavy.make_expert()
        stale.action(np.array([0.1, 0.0, 0.3, 0.0]), heavy.parameters)  # a plan for another state
        rule = ScriptedRule(range(handover, 100))
        episode = drive(heavy, rule, expert=stale, seed=seed, record_snapshots=True)
        assert episode.snapshots is not None and episode.handover == handover
        other = CartPoleEnv(disturbance="cart-mass", severity=3)
        other.reset(seed=seed)
        other.restore(episode.snapshots[handover])
        assert continue_with_expert(other, other.make_expert()) == episode.success
        np.testing.assert_array_equal(other.state, episode.states[episode.length])


def test_a_second_takeover_plans_from_scratch_too(env) -> None:
    rule = ScriptedRule([*range(5, 20), *range(40, 100)])
    episode = drive(env, rule, expert=env.make_expert(), record_snapshots=True)
    other = CartPoleEnv()
    other.reset(seed=SEED)
    other.restore(episode.snapshots[40])
    continue_with_expert(other, other.make_expert())
    np.testing.assert_array_equal(other.state, episode.states[episode.length])


def test_handing_over_without_an_expert_is_an_error(env) -> None:
    with pytest.raises(ValueError, match="no expert"):
        drive(env, ScriptedRule(range(10, 100)), expert=None)


def test_the_learner_only_trajectory_does_not_depend_on_signals_or_arming(heavy) -> None:
    base = drive(heavy, NeverSwitch(), signals=[], expert=None)
    every = [make_signal(name) for name in ("total", "total-mean3", "epistemic", "aleatoric-max5")]
    for signals, arming in ((every, "start"), (every[::-1], "onset"), ([Total()], "onset")):
        other = drive(heavy, NeverSwitch(), arming, signals=signals)
        np.testing.assert_array_equal(other.states, base.states)
        np.testing.assert_array_equal(other.actions, base.actions)
        assert set(other.signals) == {signal.id for signal in signals}
    alone, beside = (drive(heavy, NeverSwitch(), signals=signals) for signals in ([Epistemic()], every))
    np.testing.assert_array_equal(alone.signals["epistemic"], beside.signals["epistemic"])


def test_signals_are_shown_the_executed_action_of_the_step_before(env) -> None:
    signal = Recorder()
    for _ in range(2):  # reset at every episode
        episode = drive(env, ScriptedRule(range(20, 40)), signals=[signal])
        assert signal.previous[0] is None
        np.testing.assert_array_equal(np.array(signal.previous[1:]), episode.actions[:-1])
    assert signal.resets == 2


def test_an_early_end_leaves_nan_and_nobody_driving(env) -> None:
    episode = drive(env, NeverSwitch(), learner=ScriptedLearner(action=1.0), record_snapshots=True)
    assert 0 < episode.length < env.horizon == episode.horizon and not episode.success
    assert set(episode.driver[: episode.length]) == {Driver.LEARNER} and set(episode.driver[episode.length :]) == {-1}
    for values in (episode.actions, episode.signals["total"]):
        assert np.isfinite(values[: episode.length]).all() and np.isnan(values[episode.length :]).all()
    for values in (episode.states, episode.snapshots):
        assert np.isfinite(values[: episode.length + 1]).all() and np.isnan(values[episode.length + 1 :]).all()
    assert episode.learner_steps == episode.length and episode.handover == env.horizon


def test_drivers_may_be_plain_numbers_but_nothing_else(env) -> None:
    class Plain(ScriptedRule):
        def update(self, step: int, signals: Mapping[str, float]) -> Any:
            return 1

    assert drive(env, Plain(at_arming=1)).handover == 0
    assert drive(env, Plain(at_arming=0)).handover == 1
    with pytest.raises(ValueError, match="2 is not a valid Driver"):
        drive(env, Plain(at_arming=2))


def test_unknown_arming_names_the_valid_ones() -> None:
    assert [arming_step(7, "onset", 80), arming_step(None, "onset", 80), arming_step(7, "start", 80)] == [7, 80, 0]
    with pytest.raises(ValueError, match="'onset', 'start'"):
        arming_step(7, "onsett", 80)  # type: ignore[arg-type]
