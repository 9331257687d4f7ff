"""Finds learners, signals and methods by name, through entry points or as `package.module:factory`.

The suite's own baselines register exactly as anybody's package does:

    [project.entry-points."safeswitch.methods"]
    my-rule = "my_package.rules:MyRule"
"""

from __future__ import annotations

import importlib
import re
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Literal

from safeswitch.names import unknown
from safeswitch.protocols import Method, Signal, SignalContext

Kind = Literal["learner", "signal", "method"]

GROUPS: dict[Kind, str] = {
    "learner": "safeswitch.learners",
    "signal": "safeswitch.signals",
    "method": "safeswitch.methods",
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


def make_signal(signal_id: str, context: SignalContext | None = None) -> Signal:
    """A fresh signal; `total-mean3` is `total` smoothed over three steps.

    Args:
        signal_id: any signal by its full id.
        context: what signals that are fitted, or need the learners of the other seeds, are made from.
    """
    return find("signal", "smoothed")(signal_id, context)


def base_signal(signal_id: str) -> str:
    """Registered name of the signal that `signal_id` smooths, or is: `total` for `total-mean3`."""
    name = signal_id if signal_id in _entries("signal") else _SMOOTHING.sub("", signal_id)
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
    """The method `rule@signal`, or `rule` where the rule looks at no signal."""
    if ":" in method_id:
        return find("method", method_id)()
    rule, _, signal = method_id.partition("@")
    return find("method", rule)(signal or None)
