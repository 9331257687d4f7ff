"""The handover table on the real cart-pole: exactly what plain episodes give, wherever and however it is computed."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safeswitch import registry
from safeswitch.handover.episode import Episode, NeverSwitch, run_episode
from safeswitch.handover.panel import Panel
from safeswitch.handover.table import HandoverTable, concatenate, join_chunks, record_table
from safeswitch.protocols import ARMINGS, Driver
from safeswitch.tasks.cart_pole import CartPoleEnv
from safeswitch_baselines.learners.bayesian import BayesianLearner
from safeswitch_baselines.rules.base import DelayRule, ThresholdRule

SIGNALS = ("epistemic", "aleatoric", "total", "total-mean3", "epistemic-max5")
SEEDS = (0, 1, 2, 3, 4, 5)
KINDS: dict[str, dict[str, Any]] = {
    "none": {},
    "cart-mass": {"disturbance": "cart-mass", "severity": 3},
    "sensor-bias": {"disturbance": "sensor-bias", "severity": 3},
    "push": {"disturbance": "push", "severity": 3},
}


@pytest.fixture(scope="session")
def world(tiny_learner: Path) -> World:
    return World(tiny_learner)


class World:
    """The tiny learner in several cells, and the tables of a few seeds."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.learner = folder, BayesianLearner.load(folder)
        self.table = cache(self.record)
        self.env = cache(lambda kind: CartPoleEnv(**KINDS[kind]))
        self.expert = cache(lambda kind: self.env(kind).make_expert())
        self.alone = cache(lambda kind, seed: self.drive(NeverSwitch(), kind, seed))

    def record(self, kind: str, seeds: tuple[int, ...] = SEEDS) -> HandoverTable:
        env = CartPoleEnv(**KINDS[kind])  # of its own: the table resolves outcomes in it later
        return record_table(env, self.learner, self.signals(), env.make_expert(), seeds)

    def signals(self) -> list[Any]:
        return [registry.make_signal(name) for name in SIGNALS]

    def panel(self, arming: Any) -> Panel:
        table = self.table("cart-mass")
        return Panel(concatenate([table, self.table("none")]) if arming == "start" else table, arming)

    def drive(self, rule: Any, kind: str, seed: int, arming: Any = "start") -> Episode:
        expert = self.expert(kind)  # with the plan of the episode before, which must not matter
        return run_episode(self.env(kind), self.learner, self.signals(), rule, expert, seed, arming, True)


def same(one: HandoverTable, other: HandoverTable) -> None:
    for name in ("seeds", "onset", "length", "learner_success", "snapshots"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert set(one.signals) == set(other.signals)
    for name in one.signals:
        np.testing.assert_array_equal(one.signals[name], other.signals[name])


def check_rule(world: World, panel: Panel, index: int, rule: Any) -> int:
    """The plain episode under `rule` is what the table says of it, to the last bit; returns the handover step."""
    table = panel.table
    kind = "cart-mass" if table.disturbed[index] else "none"
    seed, onset, length = int(table.seeds[index]), int(table.onset[index]), int(table.length[index])
    one = panel.take(np.array([index]))
    handover = int(one.handover_of(rule)[0])
    plain = world.drive(rule, kind, seed, panel.arming)
    assert (plain.seed, plain.onset, plain.arming_step) == (seed, onset, int(panel.arming_step[index]))
    assert plain.handover == handover
    assert plain.success == bool(one.success(np.array([handover]))[0])
    assert plain.learner_steps == one.learner_steps(np.array([handover]))[0]
    assert plain.armed_learner_steps == one.armed_learner_steps(np.array([handover]))[0]
    assert plain.handovers == (handover < table.horizon)
    shared = min(handover, length)  # steps that the learner drove
    alone = world.alone(kind, seed)
    np.testing.assert_array_equal(plain.actions[:shared], alone.actions[:shared])
    np.testing.assert_array_equal(plain.states[: shared + 1], alone.states[: shared + 1])
    assert plain.snapshots is not None
    recorded = world.table(kind).snapshots
    assert recorded is not None
    np.testing.assert_array_equal(plain.snapshots[: shared + 1], recorded[SEEDS.index(seed)][: shared + 1])
    for name in SIGNALS:  # a signal of the handover step is seen before its action
        np.testing.assert_array_equal(plain.signals[name][: shared + 1], table.signals[name][index][: shared + 1])
    assert set(plain.driver[shared : plain.length]) <= {Driver.EXPERT}
    return handover


def check_triples(world: World, arming: Any, count: int, stream: int) -> None:
    """Random (episode, threshold, signal): thresholds among the trace's own values, so that handovers are spread."""
    rng, panel = np.random.default_rng([stream, len(arming)]), world.panel(arming)
    handovers = []
    for _ in range(count):
        index, name = int(rng.integers(len(panel))), str(rng.choice(SIGNALS))
        trace = panel.signal(name)[index]
        start, length = int(panel.arming_step[index]), int(panel.table.length[index])
        threshold = float(np.quantile(trace[start:length], rng.uniform(0.0, 1.0))) * rng.uniform(0.95, 1.05)
        handovers.append(check_rule(world, panel, index, ThresholdRule(name, threshold)))
    assert len(set(handovers)) > min(count / 4, 10), "the thresholds must try many handover steps"


@pytest.mark.parametrize("arming", ARMINGS)
def test_table_is_the_plain_episode_bit_for_bit(world: World, arming: Any) -> None:
    check_triples(world, arming, 12, stream=1)


@pytest.mark.slow
@pytest.mark.parametrize("arming", ARMINGS)
def test_table_is_the_plain_episode_bit_for_bit_on_many_triples(world: World, arming: Any) -> None:
    check_triples(world, arming, 120, stream=2)


@pytest.mark.parametrize("arming", ARMINGS)
def test_blind_rules_agree_too(world: World, arming: Any) -> None:
    panel = world.panel(arming)
    for delay in (0, 1, 17):
        assert check_rule(world, panel, 0, DelayRule(delay)) == panel.arming_step[0] + delay


def test_both_outcomes_occur(world: World) -> None:
    """Otherwise the tests above would compare constants."""
    panel = world.panel("onset")
    steps = panel.arming_step[:, None] + np.array([0, 5, 20])
    outcomes = panel.table.outcome(np.arange(len(panel))[:, None], np.minimum(steps, panel.table.horizon))
    assert outcomes.any() and not outcomes.all()


def test_the_table_does_not_depend_on_the_order_or_the_chunks(world: World) -> None:
    whole = world.table("cart-mass")
    backwards = world.record("cart-mass", SEEDS[::-1])
    same(backwards.take(np.arange(len(SEEDS))[::-1]), whole.take(np.arange(len(SEEDS))))
    chunks = [world.record("cart-mass", SEEDS[:2]), world.record("cart-mass", SEEDS[2:])]
    joined = join_chunks(chunks)
    same(joined, whole)
    env = CartPoleEnv(**KINDS["cart-mass"])
    joined.attach(env, env.make_expert())
    rng = np.random.default_rng(0)
    episodes, steps = rng.integers(0, len(SEEDS), 12), rng.integers(0, 60, 12)
    np.testing.assert_array_equal(joined.outcome(episodes, steps), whole.outcome(episodes, steps))
    first = episodes < 2
    apart = chunks[0].outcome(episodes[first], steps[first])
    np.testing.assert_array_equal(apart, joined.outcome(episodes, steps)[first])


def test_outcomes_do_not_depend_on_the_order_in_which_they_are_asked_for(world: World) -> None:
    one, other = world.record("cart-mass", SEEDS[:2]), world.record("cart-mass", SEEDS[:2])
    episodes, steps = np.meshgrid(np.arange(2), np.arange(0, 60, 9), indexing="ij")
    forwards = one.outcome(episodes, steps)
    backwards = [[bool(other.outcome(np.array([e]), np.array([s]))[0]) for s in range(54, -1, -9)] for e in (1, 0)]
    np.testing.assert_array_equal(forwards, np.array(backwards)[::-1, ::-1])


IN_ANOTHER_PROCESS = """
import json, sys
from pathlib import Path
import numpy as np
from safeswitch.handover.table import HandoverTable
from safeswitch.tasks.cart_pole import CartPoleEnv
env = CartPoleEnv(disturbance="cart-mass", severity=3)
table = HandoverTable.load(Path(sys.argv[1])).attach(env, env.make_expert())
episodes, steps = np.array(json.loads(sys.argv[2]))
print(json.dumps(table.outcome(episodes, steps).tolist()))
env.reset(seed=int(table.seeds[0]))
env.restore(table.snapshots[0, steps[0]])
expert = env.make_expert()
while not env.done:
    env.advance(expert.action(env.state, env.parameters))
print(json.dumps([value.hex() for value in env.state.tolist()]))
"""


def test_a_continuation_in_another_process_is_the_same(world: World, tmp_path: Path) -> None:
    table = world.table("cart-mass")
    unresolved = world.record("cart-mass")  # nothing known: the other process has to compute it
    assert (unresolved.known()[:, : unresolved.length.min()] == -1).all()
    unresolved.save(tmp_path / "table.npz")
    episodes, steps = np.repeat(np.arange(len(SEEDS)), 3), np.tile([3, 25, 40], len(SEEDS))
    pairs = json.dumps([episodes.tolist(), steps.tolist()])
    command = [sys.executable, "-c", IN_ANOTHER_PROCESS, str(tmp_path / "table.npz"), pairs]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    outcomes, state = map(json.loads, done.stdout.splitlines())
    assert outcomes == table.outcome(episodes, steps).tolist()
    plain = world.drive(DelayRule(int(steps[0])), "cart-mass", SEEDS[0])
    assert state == [value.hex() for value in plain.states[plain.length].tolist()]


def test_a_table_without_snapshots_cannot_be_given_a_simulator(world: World, tmp_path: Path) -> None:
    world.table("cart-mass").save(tmp_path / "small.npz", snapshots=False)
    small = HandoverTable.load(tmp_path / "small.npz")
    env = CartPoleEnv(**KINDS["cart-mass"])
    with pytest.raises(ValueError, match="snapshots"):
        small.attach(env, env.make_expert())
    world.table("cart-mass").save(tmp_path / "large.npz")
    assert (tmp_path / "small.npz").stat().st_size < 0.5 * (tmp_path / "large.npz").stat().st_size


def test_predictions_depend_on_seed_step_and_observation_alone(world: World) -> None:
    observation = np.array([0.1, -0.2, 3.0, 0.4])

    def ask(learner: BayesianLearner, seed: int, steps: list[int]) -> list[float]:
        learner.reset(seed)
        found = [learner.predict(observation, step) for step in steps]
        return [float(each.epistemic_var[0]) for each in found]

    base = ask(world.learner, 7, list(range(10)))
    other = BayesianLearner.load(world.folder)
    ask(other, 8, [0, 5, 2])
    assert ask(other, 7, [9, 4, 4, 0]) == [base[9], base[4], base[4], base[0]]
    assert len(set(base)) == 10 and not set(ask(other, 8, list(range(10)))) & set(base)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "none"])
def test_the_undisturbed_twin_is_identical_until_the_onset(world: World, kind: str) -> None:
    for seed in SEEDS[:3]:
        disturbed, twin = world.alone(kind, seed), world.alone("none", seed)
        onset = disturbed.onset
        assert onset > 0 and twin.onset == -1
        np.testing.assert_array_equal(disturbed.states[: onset + 1], twin.states[: onset + 1])
        np.testing.assert_array_equal(disturbed.actions[:onset], twin.actions[:onset])
        for name in SIGNALS:
            np.testing.assert_array_equal(disturbed.signals[name][:onset], twin.signals[name][:onset])
        end = min(disturbed.length, twin.length)
        assert not np.array_equal(disturbed.states[onset:end], twin.states[onset:end])


def test_a_handover_before_the_onset_still_meets_the_disturbance(world: World) -> None:
    disturbed, twin = world.table("cart-mass"), world.table("none")
    assert disturbed.snapshots is not None and twin.snapshots is not None
    env = CartPoleEnv(**KINDS["cart-mass"])
    env.reset(seed=SEEDS[0])
    before = int(disturbed.onset[0]) - 2
    env.restore(twin.snapshots[0, before])
    expert = env.make_expert()
    for _ in range(4):
        assert env.disturbed == (env.step_index >= disturbed.onset[0])
        env.advance(expert.action(env.state, env.parameters))
    assert env.disturbed
