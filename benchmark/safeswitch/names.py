"""Errors for names that do not exist: they list the valid names, nearest first."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import SequenceMatcher


def nearest(value: object, valid: Iterable[str]) -> list[str]:
    """The `valid` names without repetition, the one most like `value` first, ties in alphabetical order."""
    text = str(value).lower()
    return sorted(set(valid), key=lambda name: (-SequenceMatcher(None, text, name.lower()).ratio(), name))


def unknown(kind: str, value: object, valid: Iterable[str]) -> ValueError:
    """The error that an unknown `value` of some `kind` deserves.

    For example ``raise unknown("task", "cartpole", TASKS)``.
    """
    names = nearest(value, valid)
    listing = ", ".join(names) if names else "there are none"
    return ValueError(f"unknown {kind} {value!r}; valid, nearest first: {listing}")


def check(kind: str, value: str, valid: Iterable[str]) -> str:
    """Return `value` if it is one of the `valid` names of this `kind`, else raise the error of `unknown`."""
    names = list(valid)
    if value not in names:
        raise unknown(kind, value, names)
    return value
