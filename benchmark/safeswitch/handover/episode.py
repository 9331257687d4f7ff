"""The one control loop: learner, expert and switch rule share an episode.

An alarm at step t hands over from t + 1, as in the paper: the step on which the rule decides is executed first. The
learner predicts and the signals are computed at every step, whoever drives; a rule is asked only once it is armed.

Besides the signals a rule is told `DEVIATION` at every step at which the expert's action is known: where the expert
drives, and everywhere for a rule that is given an adviser.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from safeswitch.protocols import Arming, Array, Driver, Expert, Learner, Signal, SwitchRule

if TYPE_CHECKING:
    from safeswitch.tasks.base import TaskEnv

DEVIATION = "deviation"
"""Name under which a rule is told |a_learner - a_expert|, the Euclidean norm in action units."""


@dataclass(frozen=True)
class Episode:
    """One episode as it was driven. T is the task's full length; entries after an early end are NaN (driver: -1).

    Attributes:
        seed: episode seed.
        onset: step t0 of the disturbance, -1 when undisturbed; T when the disturbance never came into view.
        arming_step: first step at which the rule was asked.
        length: steps executed; < T after an early failure.
        success: the task's criterion at the end; never where the expert found no finite plan at some step.
        driver: (T,) int8, `Driver` of each step.
        actions: (T, nu), executed actions in action units.
        states: (T + 1, nx), full states, SI units.
        signals: signal id -> (T,).
        snapshots: (T + 1, ns) environment snapshots, or None when they were not asked for.
    """

    seed: int
    onset: int
    arming_step: int
    length: int
    success: bool
    driver: NDArray[np.int8]
    actions: Array
    states: Array
    signals: Mapping[str, Array] = field(default_factory=dict)
    snapshots: Array | None = None

    @property
    def horizon(self) -> int:
        """Full length T in steps."""
        return len(self.driver)

    @property
    def handover(self) -> int:
        """First step that the expert drives; T if it never does."""
        driven = np.flatnonzero(self.driver == Driver.EXPERT)
        return int(driven[0]) if driven.size else self.horizon

    @property
    def handovers(self) -> int:
        """How often control passed from the learner to the expert."""
        driver = np.concatenate([[Driver.LEARNER], self.driver[: self.length]])
        return int(np.sum((driver[1:] == Driver.EXPERT) & (driver[:-1] == Driver.LEARNER)))

    @property
    def learner_steps(self) -> int:
        """Steps that the learner drove."""
        return int(np.sum(self.driver == Driver.LEARNER))

    @property
    def armed_learner_steps(self) -> int:
        """Steps that the learner drove from the arming step on."""
        return int(np.sum(self.driver[self.arming_step :] == Driver.LEARNER))


class NeverSwitch:
    """The rule that leaves the learner in control."""

    def reset(self, seed: int) -> None:
        """Nothing to forget."""

    def arm(self, step: int) -> Driver:
        """The learner drives."""
        return Driver.LEARNER

    def update(self, step: int, signals: Mapping[str, float]) -> Driver:
        """The learner drives on."""
        return Driver.LEARNER


def arming_step(onset: int | None, arming: Arming, horizon: int) -> int:
    """First step at which the monitor is on: t0 under `onset` (T, that is never, undisturbed), 0 under `start`."""
    if arming == "start":
        return 0
    if arming == "onset":
        return horizon if onset is None or onset < 0 else onset
    raise ValueError(f"arming {arming!r} is not one of 'onset', 'start'")


def run_episode(
    env: TaskEnv,
    learner: Learner,
    signals: Sequence[Signal],
    rule: SwitchRule,
    expert: Expert | None,
    seed: int,
    arming: Arming = "start",
    record_snapshots: bool = False,
    adviser: Expert | None = None,
) -> Episode:
    """Drive the episode `seed` of `env` with the learner, and with the expert whenever `rule` says so.

    Args:
        env: the unwrapped task.
        learner: predicts at every step; its randomness is keyed by (`seed`, step).
        signals: what the rule may look at, computed at every step in this order.
        rule: decides the driver of each step.
        expert: None is allowed for a rule that never hands over.
        seed: episode seed.
        arming: when the rule is switched on.
        record_snapshots: keep what a later continuation from any step needs.
        adviser: an expert of its own that is asked at every armed step which the learner drives, and whose action is
            never executed; for rules that need expert queries.
    """
    env.reset(seed=seed)
    learner.reset(seed)
    rule.reset(seed)
    for signal in signals:
        signal.reset()
    horizon = env.horizon
    driven = np.full(horizon, -1, np.int8)
    actions = np.full((horizon, *env.simulator.action_shape), np.nan)
    states = np.full((horizon + 1, env.state.size), np.nan)
    traces = {signal.id: np.full(horizon, np.nan) for signal in signals}
    snapshots = [env.snapshot()] if record_snapshots else []
    states[0] = env.state
    driver, previous, failed_before = Driver.LEARNER, None, solver_failures(expert)
    while not env.done:
        step = env.step_index
        observation = env.observe()
        prediction = learner.predict(observation, step)
        values = {signal.id: signal.update(observation, prediction, previous) for signal in signals}
        armed_from = arming_step(env.onset, arming, horizon)  # of a placed disturbance: T until it is in view
        if step == armed_from:
            driver = Driver(rule.arm(step))
        action = _expert_action(env, expert, driven, step) if driver is Driver.EXPERT else prediction.action
        if adviser is not None and driver is Driver.LEARNER and step >= armed_from:
            advice = _advice(env, adviser, driven, step, armed_from)
        env.advance(action)
        driven[step], actions[step], states[step + 1] = driver, action, env.state
        for name, value in values.items():
            traces[name][step] = value
        if record_snapshots:
            snapshots.append(env.snapshot())
        if step >= armed_from:
            if driver is Driver.EXPERT:
                values[DEVIATION] = _distance(prediction.action, action)
            elif adviser is not None:
                values[DEVIATION] = _distance(prediction.action, advice)
            driver = Driver(rule.update(step, values))
        previous = actions[step]
    length = env.step_index
    onset = -1 if env.onset is None else env.onset
    armed_from = arming_step(env.onset, arming, horizon)
    success = env.is_success and solver_failures(expert) == failed_before
    return Episode(
        seed, onset, armed_from, length, success, driven, actions, states, traces, _stack(snapshots, horizon)
    )


def continue_with_expert(env: TaskEnv, expert: Expert) -> bool:
    """Let the expert drive from the current state, planning from scratch, to the end.

    True on success: the task's criterion, and a finite plan at every step.
    """
    expert.reset()
    before = solver_failures(expert)
    while not env.done:
        env.advance(expert.action(env.state, env.parameters))
    return env.is_success and solver_failures(expert) == before


def solver_failures(expert: Expert | None) -> int:
    """How often an expert has found no finite plan; 0 for one that does not count it (attribute `fallbacks`)."""
    return getattr(expert, "fallbacks", 0)


def _expert_action(env: TaskEnv, expert: Expert | None, driven: NDArray[Any], step: int) -> Array:
    if expert is None:
        raise ValueError("the switch rule handed over, but the episode was given no expert")
    if step == 0 or driven[step - 1] != Driver.EXPERT:
        expert.reset()
    return expert.action(env.state, env.parameters)


def _advice(env: TaskEnv, adviser: Expert, driven: NDArray[Any], step: int, armed_from: int) -> Array:
    """What the adviser would do; it plans from scratch when it is first asked, and after the expert has driven."""
    if step == armed_from or driven[step - 1] == Driver.EXPERT:
        adviser.reset()
    return adviser.action(env.state, env.parameters)


def _distance(one: Array, other: Array) -> float:
    return math.dist(one, other)


def _stack(snapshots: list[Array], horizon: int) -> Array | None:
    if not snapshots:
        return None
    stacked = np.full((horizon + 1, snapshots[0].size), np.nan)
    stacked[: len(snapshots)] = snapshots
    return stacked
