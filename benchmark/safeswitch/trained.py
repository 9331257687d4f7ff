"""A trained learner and what its signals are made from, as keys in the store: what a job needs to drive episodes."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium

from safeswitch import factories, registry
from safeswitch.files import load_arrays
from safeswitch.protocols import Signal, SignalContext
from safeswitch.store import Key

if TYPE_CHECKING:
    from safeswitch.suite import Task


@cache
def load_learner(task: Task, folder: str) -> Any:
    """The trained learner, loaded once per process."""
    return factories.load(task.learner, Path(folder), lambda: gymnasium.make(task.env_id).unwrapped)


@cache
def _load_fits(folder: str) -> dict[str, dict[str, Any]]:
    """Arrays of every fitted signal in a result of the stage "signal fits", loaded once per process."""
    return {path.stem: load_arrays(path) for path in sorted(Path(folder).glob("*.npz"))}


def base_signals(signals: Iterable[str]) -> tuple[str, ...]:
    """The unsmoothed signals behind these ids, each once, in order."""
    return tuple(dict.fromkeys(registry.base_signal(signal) for signal in signals))


def fitted_signals(task: Task) -> tuple[str, ...]:
    """The task's unsmoothed signals that are fitted to training features."""
    return tuple(base for base in base_signals(task.signals) if registry.is_fitted(registry.find("signal", base)))


def needs_members(signal: str) -> bool:
    """Whether a signal is made from the learners of the other seeds."""
    return registry.has_members(registry.find("signal", registry.base_signal(signal)))


def signals_of(task: Task, learners: int) -> tuple[str, ...]:
    """The task's signals that can be made with so many learners: an ensemble needs at least two."""
    return tuple(signal for signal in task.signals if learners > 1 or not needs_members(signal))


def with_signals_of(task: Task, learners: int) -> Task:
    """The task with the signals that can be made; every stage of a run sees this one list."""
    return replace(task, signals=signals_of(task, learners))


@dataclass(frozen=True)
class Trained:
    """One learner of a run.

    Attributes:
        root: folder of the store.
        seed: learner seed.
        key: of the learner.
        fits: key of what its signals were fitted to; None where the task has no fitted signal.
        members: keys of the learners of the other seeds; empty where no signal needs them.
    """

    root: str
    seed: int
    key: Key
    fits: Key | None = None
    members: tuple[Key, ...] = ()

    @property
    def keys(self) -> list[str]:
        """Keys of everything that an episode with this learner depends on."""
        return [self.key, *([] if self.fits is None else [self.fits]), *self.members]

    def learner(self, task: Task) -> Any:
        """The learner."""
        return self._load(task, self.key)

    def signals(self, task: Task, chosen: Collection[str] | None = None) -> list[Signal]:
        """The task's signals for this learner, or the `chosen` ones of them, for one episode at a time."""
        fits = {} if self.fits is None else _load_fits(str(Path(self.root) / self.fits))
        context = SignalContext(fits, tuple(self._load(task, key) for key in self.members))
        names = [signal for signal in task.signals if chosen is None or signal in chosen]
        return [registry.make_signal(signal, context) for signal in names]

    def _load(self, task: Task, key: str) -> Any:
        return load_learner(task, str(Path(self.root) / key))
