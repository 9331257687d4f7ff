"""The handover table seen through an arming: where any latched rule hands over, and what that earns."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safeswitch.handover.outcomes import SUCCESS, UNKNOWN
from safeswitch.handover.table import Bools, HandoverTable, Ints
from safeswitch.names import unknown
from safeswitch.protocols import ARMINGS, Arming, Array, Driver, SwitchRule

PHI = 5.0
"""Reward of success in the headline, in units of a whole episode driven by the learner (DESIGN section 2)."""

DELAY_STEP = 5
"""Resolution of the timer's first search [steps]; the second one has a resolution of one step."""


@dataclass(frozen=True)
class Panel:
    """Episodes on which latched rules are scored under one arming.

    Attributes:
        table: the episodes; under `start` the disturbed ones and their undisturbed twins.
        arming: `onset` or `start`.
    """

    table: HandoverTable
    arming: Arming
    _running_max: dict[str, Array] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.arming not in ARMINGS:
            raise unknown("arming", self.arming, ARMINGS)
        if self.arming == "onset" and not self.table.disturbed.all():
            raise ValueError("under 'onset' arming every episode must be disturbed: the monitor is armed at t0")

    def __len__(self) -> int:
        return len(self.table)

    @cached_property
    def arming_step(self) -> Ints:
        """(E,) first step at which the rule is asked."""
        return self.table.onset if self.arming == "onset" else np.zeros(len(self), np.int64)

    def take(self, index: NDArray[np.integer] | Bools) -> Panel:
        """The panel of the chosen episodes."""
        return Panel(self.table.take(index), self.arming)

    def with_signal(self, name: str, trace: Array) -> Panel:
        """The same panel with the signal `name`, (E, T), added or replaced."""
        return Panel(self.table.with_signal(name, trace), self.arming)

    def signal(self, name: str) -> Array:
        """(E, T) the signal at every step, NaN after an early end."""
        if name not in self.table.signals:
            raise unknown("signal", name, self.table.signals)
        return self.table.signals[name]

    def running_max(self, name: str) -> Array:
        """(E, T) maximum of the signal from the arming step on; -inf before it."""
        if name not in self._running_max:
            armed = np.arange(self.table.horizon)[None, :] >= self.arming_step[:, None]
            trace = np.where(armed & ~np.isnan(self.signal(name)), self.signal(name), -np.inf)
            self._running_max[name] = np.maximum.accumulate(trace, axis=1)
        return self._running_max[name]

    def handover_at(self, name: str, thresholds: Array) -> Ints:
        """(n, E) handover step of `signal > threshold`, latched, for each of n thresholds; T where it never alarms."""
        thresholds = np.atleast_1d(np.asarray(thresholds, float))
        running = self.running_max(name)
        alarm = np.stack([np.searchsorted(row, thresholds, side="right") for row in running], axis=1)
        return self.executed(alarm + 1)

    def executed(self, handover: NDArray[np.integer]) -> Ints:
        """Handover steps (..., E) that come after the episode's end do not take place: T."""
        return np.where(handover >= self.table.length, self.table.horizon, handover)

    def handover_of(self, rule: Any) -> Ints:
        """(E,) handover step of a latched rule.

        A rule may offer `handover_steps(panel)` as a shortcut (or because it needs the table, as an oracle does);
        any other is asked step by step, exactly as in an episode.
        """
        if hasattr(rule, "handover_steps"):
            return self.executed(np.asarray(rule.handover_steps(self), np.int64))
        return self.executed(np.array([self._ask(rule, episode) for episode in range(len(self))], np.int64))

    def _ask(self, rule: SwitchRule, episode: int) -> int:
        start, length = int(self.arming_step[episode]), int(self.table.length[episode])
        rule.reset(int(self.table.seeds[episode]))
        if rule.arm(start) == Driver.EXPERT:
            return start
        for step in range(start, length):
            values = {name: float(trace[episode, step]) for name, trace in self.table.signals.items()}
            if rule.update(step, values) == Driver.EXPERT:
                return step + 1
        return self.table.horizon

    def success(self, handover: Ints) -> Bools:
        """Success (..., E) of handing over at the steps (..., E)."""
        return self.table.outcome(np.arange(len(self)), handover)

    def learner_steps(self, handover: Ints) -> Ints:
        """Steps (..., E) that the learner drives, from step 0."""
        return np.minimum(handover, self.table.length)

    def armed_learner_steps(self, handover: Ints) -> Ints:
        """Steps (..., E) that the learner drives from the arming step on."""
        return np.maximum(self.learner_steps(handover) - self.arming_step, 0)

    def returns(self, handover: Ints, phi: float = PHI) -> Array:
        """Return (..., E): 1/T for each learner-driven step from the arming step on, and phi on success."""
        return self.armed_learner_steps(handover) / self.table.horizon + phi * self.success(handover)

    def expert_share(self, handover: Ints) -> Array:
        """Share (..., E) of the T steps that the expert drives."""
        ended = handover >= self.table.length
        return np.where(ended, 0.0, (self.table.horizon - handover) / self.table.horizon)

    def candidate_thresholds(self, name: str) -> Array:
        """(n,) thresholds among which every distinct set of handover steps occurs, increasing, -inf first."""
        values = np.unique(self.running_max(name))
        return np.concatenate([[-np.inf], values[np.isfinite(values)]])

    def best_threshold(self, name: str, phi: float = PHI) -> tuple[float, float]:
        """Threshold with the highest mean return on these episodes, and that return (the lowest such threshold)."""
        thresholds = self.candidate_thresholds(name)
        best, value = self.best_of(self.handover_at(name, thresholds), phi)
        return float(thresholds[best]), value

    def best_of(self, handover: Ints, phi: float = PHI) -> tuple[int, float]:
        """Row of handover steps (n, E) with the highest mean return, the first of equal ones, and that return.

        Only outcomes that can change the answer are asked for: as long as they are unknown they count as a success, and
        those of the row that looks best are computed until the best row has no unknown ones.
        """
        episodes = np.arange(len(self))
        earned = self.armed_learner_steps(handover) / self.table.horizon
        while True:
            known = self.table.known()[episodes, handover]
            returns = (earned + phi * ((known == SUCCESS) | (known == UNKNOWN))).mean(axis=1)
            best = int(np.argmax(returns))
            if (known[best] != UNKNOWN).all():
                return best, float(returns[best])
            self.success(handover[best])

    def margins(self, name: str, phi: float = PHI) -> tuple[float, float]:
        """Thresholds between which a constant threshold is worth having: the run of thresholds around the best one
        whose mean return is above that of learner, expert and timer. NaN, NaN where there is none.
        """
        thresholds, trivial = self.candidate_thresholds(name), self.trivial_return(phi)
        handover = self.handover_at(name, thresholds)
        low, value = self.best_of(handover, phi)
        if value <= trivial:
            return float("nan"), float("nan")
        high = low + 1  # outwards, so that no outcome is asked for beyond the first threshold that is not worth it
        while low > 0 and float(self.returns(handover[low - 1], phi).mean()) > trivial:
            low -= 1
        while high < len(handover) and float(self.returns(handover[high], phi).mean()) > trivial:
            high += 1
        return float(thresholds[low]), float(thresholds[high]) if high < len(handover) else np.inf

    def trivial_return(self, phi: float = PHI) -> float:
        """R0: the best mean return without any signal, of the learner, the expert, or the best delay (timer)."""
        horizon = self.table.horizon
        never = np.full(len(self), horizon)
        delayed = self.delayed(np.array([self.best_delay(phi)[0]]))[0]
        choices = (never, self.executed(self.arming_step), delayed)
        return max(float(self.returns(handover, phi).mean()) for handover in choices)

    def best_delay(self, phi: float = PHI) -> tuple[int, Ints]:
        """Delay after the arming step [steps] with the highest mean return when every episode hands over after it.

        Delays at multiples of `DELAY_STEP` and T (never) are tried first, then every delay around the best of them.

        Returns:
            The delay, and all delays that were tried, increasing.
        """
        horizon = self.table.horizon
        coarse = np.append(np.arange(0, horizon, DELAY_STEP), horizon)
        best = int(coarse[self.best_of(self.delayed(coarse), phi)[0]])
        near = np.arange(max(best - DELAY_STEP + 1, 0), min(best + DELAY_STEP, horizon + 1))
        return int(near[self.best_of(self.delayed(near), phi)[0]]), np.union1d(coarse, near)

    def delayed(self, delays: NDArray[np.integer]) -> Ints:
        """(n, E) handover step of handing every episode over n delays after its arming step; T where it has ended."""
        return self.executed(np.minimum(self.arming_step + np.asarray(delays)[:, None], self.table.horizon))


@dataclass(frozen=True)
class Calibration:
    """What a method may use to choose its free parameters, for one (learner, cell, arming).

    Attributes:
        panel: the calibrate episodes of the cell under the arming.
        nominal: table of undisturbed calibrate episodes, all that a method may use that does not need failures.
        phi: reward of success.
        seed: seed for the method's own random draws.
    """

    panel: Panel
    nominal: HandoverTable
    phi: float = PHI
    seed: int = 0
