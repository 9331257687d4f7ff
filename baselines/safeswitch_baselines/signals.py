"""Signals: one number per step that should rise when the learner should not drive, in action units.

    epistemic = sqrt(sum_i epistemic_var_i)     the learner does not know
    aleatoric = sqrt(sum_i aleatoric_var_i)     the labels are noisy there
    total     = sqrt(sum_i (epistemic_var_i + aleatoric_var_i))

Smoothing is part of a signal's id: `total-mean3` is the mean of `total` over the last three steps (over all of them
while there are fewer), `-maxN` and `-minN` their maximum and minimum. It looks back, never ahead.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safeswitch import registry
from safeswitch.names import nearest, unknown
from safeswitch.protocols import Array, Prediction, Signal


class Epistemic:
    """Standard deviation of the posterior samples' means [action units]."""

    id = "epistemic"

    def reset(self) -> None:
        """Nothing to forget."""

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        """Value at this step."""
        return math.sqrt(_sum(prediction.epistemic_var))


class Aleatoric:
    """Standard deviation of the predicted label noise [action units]."""

    id = "aleatoric"

    def reset(self) -> None:
        """Nothing to forget."""

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        """Value at this step."""
        return math.sqrt(_sum(prediction.aleatoric_var))


class Total:
    """Standard deviation of the prediction, both parts together [action units]: the paper's signal."""

    id = "total"

    def reset(self) -> None:
        """Nothing to forget."""

    def update(self, observation: NDArray[Any], prediction: Prediction, previous_action: Array | None) -> float:
        """Value at this step."""
        return math.sqrt(_sum(prediction.epistemic_var) + _sum(prediction.aleatoric_var))


def _sum(variances: Array) -> float:
    return float(np.add.reduce(variances))


SIGNALS: dict[str, Callable[[], Signal]] = {"epistemic": Epistemic, "aleatoric": Aleatoric, "total": Total}
"""Factories of the unsmoothed signals by id."""

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


def make_signal(signal_id: str, factories: Mapping[str, Callable[[], Signal]] | None = None) -> Signal:
    """A fresh signal, smoothed if its id says so.

    Args:
        signal_id: for example "total" or "epistemic-max5".
        factories: unsmoothed signals by id; None for the baselines' own and those that other packages register.

    Raises:
        ValueError: unknown signal or smoothing; the message lists the valid ones, nearest first.
    """
    known = _registered() if factories is None else factories
    if signal_id in known:
        return known[signal_id]()
    base, word, length = split_id(signal_id)
    if base not in known:
        raise unknown("signal", base, known)
    return known[base]() if word is None else Smoothed(known[base](), word, length)


def _registered() -> dict[str, Callable[[], Signal]]:
    """The baselines' signals and those of other packages, which are imported only when they are made."""
    others = (name for name in registry.names("signal") if name not in SIGNALS and name != "smoothed")
    return {**{name: _Registered(name) for name in others}, **SIGNALS}


class _Registered:
    """Factory of a signal that another package registers as an entry point."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __call__(self) -> Signal:
        signal: Signal = registry.find("signal", self._name)()
        return signal
