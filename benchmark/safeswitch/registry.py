"""Finds learners, signals and methods by name, through entry points or as `package.module:factory`.

The suite's own baselines register exactly as anybody's package does:

    [project.entry-points."safeswitch.methods"]
    my-rule = "my_package.rules:MyRule"
"""

from __future__ import annotations

import importlib
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

from safeswitch.names import unknown
from safeswitch.protocols import Method, Signal

Kind = Literal["learner", "signal", "method"]

GROUPS: dict[Kind, str] = {
    "learner": "safeswitch.learners",
    "signal": "safeswitch.signals",
    "method": "safeswitch.methods",
}


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


def make_signal(signal_id: str) -> Signal:
    """A fresh signal; `total-mean3` is `total` smoothed over three steps."""
    return find("signal", "smoothed")(signal_id)


def make_method(method_id: str) -> Method:
    """The method `rule@signal`, or `rule` where the rule looks at no signal."""
    if ":" in method_id:
        return find("method", method_id)()
    rule, _, signal = method_id.partition("@")
    return find("method", rule)(signal or None)
