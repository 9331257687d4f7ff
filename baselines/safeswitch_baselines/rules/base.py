"""What the methods of this package share: latched rules, and the id grammar `rule@signal`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from safeswitch.handover.panel import Panel
from safeswitch.handover.table import Ints
from safeswitch.protocols import Driver


class ThresholdRule:
    """Latched: hands over once `signal > threshold` at an armed step, and the expert drives to the end.

    Args:
        signal: id of the signal, for example "total-mean3".
        threshold: in the signal's units (action units for variances of the action).
    """

    def __init__(self, signal: str, threshold: float):
        self.signal, self.threshold = signal, float(threshold)
        self._driver = Driver.LEARNER

    def reset(self, seed: int) -> None:
        """Give the learner control."""
        self._driver = Driver.LEARNER

    def arm(self, step: int) -> Driver:
        """Nothing was measured yet while armed: the learner drives."""
        return self._driver

    def update(self, step: int, signals: Mapping[str, float]) -> Driver:
        """Alarm if the signal is above the threshold."""
        if signals[self.signal] > self.threshold:
            self._driver = Driver.EXPERT
        return self._driver

    def handover_steps(self, panel: Panel) -> Ints:
        """(E,) handover steps on a table, all episodes at once."""
        return panel.handover_at(self.signal, np.array([self.threshold]))[0]


class DelayRule:
    """Latched: hands over `delay` steps after the arming step, blind to every signal."""

    def __init__(self, delay: int):
        self.delay = int(delay)
        self._start = 0

    def reset(self, seed: int) -> None:
        """Nothing to forget: `arm` sets the clock."""

    def arm(self, step: int) -> Driver:
        """Start the clock."""
        self._start = step
        return Driver.EXPERT if self.delay == 0 else Driver.LEARNER

    def update(self, step: int, signals: Mapping[str, float]) -> Driver:
        """The expert drives from `delay` steps after the arming step on."""
        return Driver.EXPERT if step + 1 - self._start >= self.delay else Driver.LEARNER


def expert_steps(panel: Panel, handover: Ints) -> int:
    """Steps that the expert drives, added up over all episodes and candidates: what a search asks of the expert."""
    return round(float(panel.expert_share(handover).sum()) * panel.table.horizon)


class SignalMethod:
    """Base of methods on one signal; `family` is the part of the id before the `@`."""

    family: ClassVar[str]
    latched = True
    needs: frozenset[str] = frozenset()

    def __init__(self, signal: str | None):
        if not signal:
            raise ValueError(f"method {self.family!r} needs a signal: write '{self.family}@total', for example")
        self.signal = signal

    @property
    def id(self) -> str:
        """`rule@signal`."""
        return f"{self.family}@{self.signal}"


class PlainMethod:
    """Base of methods that look at no signal; `family` is the whole id."""

    family: ClassVar[str]
    latched = True
    needs: frozenset[str] = frozenset()

    def __init__(self, signal: str | None = None):
        if signal:
            raise ValueError(f"method {self.family!r} uses no signal, got {signal!r}: write '{self.family}'")

    @property
    def id(self) -> str:
        """The rule's name alone."""
        return self.family
