"""Finds learners, signals and methods by name, through entry points or as `package.module:factory`.

The suite's own baselines register exactly as anybody's package does:

    [project.entry-points."safeswitch.methods"]
    my-rule = "my_package.rules:MyRule"
"""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Callable, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from safeswitch.names import unknown
from safeswitch.protocols import Calibrated, Method, Signal, SignalContext, SwitchRule

if TYPE_CHECKING:
    from safeswitch.handover.panel import Calibration

Kind = Literal["learner", "signal", "method", "task"]

GROUPS: dict[Kind, str] = {
    "learner": "safeswitch.learners",
    "signal": "safeswitch.signals",
    "method": "safeswitch.methods",
    "task": "safeswitch.tasks",
}

_SMOOTHING = re.compile(r"-[a-z]+[0-9]+$")


@cache
def _entries(kind: Kind) -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUPS[kind])}


def names(kind: Kind) -> list[str]:
    """Registered names of a kind, sorted."""
    return sorted(_entries(kind))


def find(kind: Kind, name: str) -> Any:
    """The object registered as `name`, or the one that `package.module:factory` names.

    Raises:
        ValueError: no such name; the message lists the valid ones, nearest first.
    """
    if ":" in name:
        module, _, attribute = name.partition(":")
        try:
            return getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            raise ValueError(f"{kind} {name!r} cannot be imported: {error}") from error
    if name not in _entries(kind):
        raise unknown(kind, name, names(kind))
    return _entries(kind)[name].load()


def package_folder(kind: Kind, name: str) -> Path:
    """Folder of the top-level package that registers `name`, found without importing the object itself."""
    if name not in _entries(kind):
        raise unknown(kind, name, names(kind))
    package = importlib.import_module(_entries(kind)[name].module.partition(".")[0])
    return Path(next(iter(package.__path__)))


def make_signal(
    signal_id: str,
    context: SignalContext | None = None,
    factories: Mapping[str, Callable[..., Signal]] | None = None,
) -> Signal:
    """A fresh signal; `total-mean3` is `total` smoothed over three steps.

    Args:
        signal_id: any signal by its full id.
        context: what signals that are fitted, or need the learners of the other seeds, are made from.
        factories: unsmoothed signals by id, instead of the registered ones.
    """
    return find("signal", "smoothed")(signal_id, context, factories)


def base_signal(signal_id: str) -> str:
    """Registered name of the signal that `signal_id` smooths, or is: `total` for `total-mean3`."""
    name = signal_id if signal_id in _entries("signal") else _SMOOTHING.sub("", signal_id)
    if ":" in name:  # somebody's own, not registered
        return name
    if name not in _entries("signal"):
        raise unknown("signal", name, names("signal"))
    return name


def is_fitted(factory: Any) -> bool:
    """Whether a signal's factory has to be fitted to training features (see `protocols.Signal`)."""
    return hasattr(factory, "fit")


def has_members(factory: Any) -> bool:
    """Whether a signal's factory takes the learners of the other seeds."""
    return bool(getattr(factory, "members", False))


def make_method(method_id: str) -> Method:
    """The method `rule@signal`, or `rule` where the rule looks at no signal.

    The factory of a rule that is not registered, `package.module:factory`, is called with the signal if there is one.
    It may make a bare `SwitchRule`, which then has nothing to calibrate.
    """
    rule, _, signal = method_id.partition("@")
    factory = find("method", rule)
    arguments = (signal or None,) if ":" not in rule else (signal,) if signal else ()
    if ":" in rule:
        _check_call(rule, factory, arguments)
    made = factory(*arguments)
    if hasattr(made, "calibrate"):
        return made
    if missing := [name for name in ("reset", "arm", "update") if not hasattr(made, name)]:
        raise ValueError(
            f"rule {rule!r} made a {type(made).__name__} without {' and '.join(missing)}: it must be a Method (with "
            "`calibrate`) or a SwitchRule (with `reset`, `arm` and `update`), see safeswitch.protocols"
        )
    return ReadyRule(method_id, made)


class ReadyRule:
    """The method of a bare switch rule: nothing is calibrated.

    Attributes:
        id: as on the command line.
        rule: the rule, which may say `latched`, `needs` and `reads` as a method does.
        needs: what the rule says that it needs.
        latched: whether it never gives control back: True unless it says otherwise.
        reads: ids of the signals that it looks at.
    """

    def __init__(self, id_: str, rule: SwitchRule) -> None:
        self.id, self.rule = id_, rule
        self.needs: frozenset[str] = frozenset(getattr(rule, "needs", ()))
        self.latched = bool(getattr(rule, "latched", True))
        self.reads: tuple[str, ...] = tuple(getattr(rule, "reads", ()))

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """The rule as it is."""
        return Calibrated(self.rule)


def _check_call(name: str, factory: Any, arguments: tuple[Any, ...]) -> None:
    if not callable(factory):
        raise ValueError(f"rule {name!r} is a {type(factory).__name__}: it must be a class or function that makes one")
    try:
        inspect.signature(factory).bind(*arguments)
    except TypeError as error:
        hint = f"write {name}@total, for example" if not arguments else f"write {name} without a signal"
        raise ValueError(f"rule {name!r} cannot be made with {arguments}: {error}; {hint}") from error
