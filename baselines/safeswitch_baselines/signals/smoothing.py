"""Makes any signal by its id. Smoothing is part of the id: `total-mean3` is the mean of `total` over three steps.

The window holds the last N steps (all of them while there are fewer); `-meanN`, `-maxN` and `-minN` sum it up. It looks
back, never ahead. Signals made in one context share their unsmoothed base: `ensemble` and `ensemble-mean3` ask the
members of an ensemble once a step, not twice.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from numpy.typing import NDArray

from safeswitch import registry
from safeswitch.names import nearest, unknown
from safeswitch.protocols import Array, Prediction, Signal, SignalContext
from safeswitch_baselines.signals.discrepancy import Discrepancy
from safeswitch_baselines.signals.dynamics import DynamicsResidual
from safeswitch_baselines.signals.features import KNN, RND, Mahalanobis
from safeswitch_baselines.signals.uncertainty import Aleatoric, Ensemble, Epistemic, Total

SIGNALS: dict[str, Callable[..., Signal]] = {
    each.id: each
    for each in (Epistemic, Aleatoric, Total, Ensemble, Mahalanobis, KNN, RND, DynamicsResidual, Discrepancy)
}
"""Factories of the unsmoothed signals by id. What they are called with depends on their kind, see `protocols`."""

REDUCTIONS: dict[str, Callable[[deque[float]], float]] = {
    # fsum rounds once, so the mean of a window does not depend on the order in which it was filled.
    "mean": lambda window: math.fsum(window) / len(window),
    "max": max,
    "min": min,
}
"""How a window is summed up, by the word in the signal's id."""

_SUFFIX = re.compile(r"(?P<base>.+)-(?P<word>[a-z]+)(?P<length>[0-9]+)")


class Smoothed:
    """A signal over a window of the last steps.

    Args:
        base: signal to smooth.
        word: "mean", "max" or "min".
        length: N >= 2, steps in a full window.
    """

    def __init__(self, base: Signal, word: str, length: int) -> None:
        if word not in REDUCTIONS:
            raise unknown("smoothing", word, REDUCTIONS)
        if length < 2:
            raise ValueError(f"a smoothing window has at least 2 steps, got {length}: use {base.id!r} itself")
        self.base = base
        self.id = f"{base.id}-{word}{length}"
        self._reduce = REDUCTIONS[word]
        self._window: deque[float] = deque(maxlen=length)

    def reset(self) -> None:
        """Start an episode with an empty window."""
        self.base.reset()
        self._window.clear()

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        """Value over this step and those before it."""
        self._window.append(self.base.update(observation, prediction, previous_action))
        return self._reduce(self._window)


class _Source:
    """An unsmoothed signal that several read: it is updated by the first of them that comes to a new step."""

    def __init__(self, signal: Signal) -> None:
        self.signal = signal
        self.steps = 0
        self.value = math.nan


class _Reader:
    """One reader of a `_Source`: all readers are reset before an episode and updated at every step of it."""

    def __init__(self, id_: str, source: _Source) -> None:
        self._source = source
        self._steps = 0
        self.id = id_  # by which it was asked for: `package.module:factory` for one that is not registered

    def reset(self) -> None:
        """Start an episode, of the source too."""
        self._source.signal.reset()
        self._source.steps = self._steps = 0

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        """The source's value at this step."""
        source = self._source
        if self._steps == source.steps:
            source.value = source.signal.update(observation, prediction, previous_action)
            source.steps += 1
        self._steps = source.steps
        return source.value


def split_id(signal_id: str) -> tuple[str, str | None, int]:
    """Base id, smoothing word and window: `total-mean3` -> ("total", "mean", 3), `total` -> ("total", None, 1).

    Only a word followed by a number is a suffix, so ids with hyphens such as `dynamics-residual` stay whole.
    """
    match = _SUFFIX.fullmatch(signal_id)
    if match is None:
        return signal_id, None, 1
    word, length = match["word"], match["length"]
    if word not in REDUCTIONS:
        raise ValueError(
            f"unknown smoothing {word!r} in signal {signal_id!r}; valid, nearest first: "
            f"{', '.join(nearest(word, REDUCTIONS))}"
        )
    if length != str(int(length)):
        raise ValueError(f"write the window of signal {signal_id!r} without leading zeros: {int(length)}")
    return match["base"], word, int(length)


def make_signal(
    signal_id: str,
    context: SignalContext | None = None,
    factories: Mapping[str, Callable[..., Signal]] | None = None,
) -> Signal:
    """A fresh signal, smoothed if its id says so.

    Args:
        signal_id: for example "total" or "epistemic-max5".
        context: what fitted signals and ensembles are made from. Signals made in one context belong to one episode at
            a time: they share what they smooth.
        factories: unsmoothed signals by id; None for the baselines' own and those that other packages register.

    Raises:
        ValueError: unknown signal or smoothing (the message lists the valid ones, nearest first), or a signal that
            needs what the context does not hold.
    """
    known = {*SIGNALS, *registry.names("signal")} - {"smoothed"} if factories is None else factories
    base, word, length = (signal_id, None, 1) if signal_id in known else split_id(signal_id)
    if base not in known and ":" not in base:
        raise unknown("signal", base, known)
    factory = (factories or SIGNALS).get(base) or registry.find("signal", base)
    signal = _made(base, factory, context)
    return signal if word is None else Smoothed(signal, word, length)


def _made(base: str, factory: Callable[..., Signal], context: SignalContext | None) -> Signal:
    """The unsmoothed signal; in a context, a reader of the one that is there already."""
    if context is None:
        context = SignalContext()
    if base not in context.shared:
        context.shared[base] = _Source(_new(base, factory, context))
    return _Reader(base, context.shared[base])


def _new(base: str, factory: Callable[..., Signal], context: SignalContext) -> Signal:
    if registry.is_fitted(factory):
        if base not in context.fits:
            raise ValueError(
                f"signal {base!r} is fitted to a learner's training features: pass a SignalContext whose fits have it"
            )
        return factory(context.fits[base])
    if registry.has_members(factory):
        if not context.members:
            raise ValueError(f"signal {base!r} needs the learners of other seeds: pass SignalContext(members=...)")
        return factory(context.members)
    return factory()
