"""Arrays on a page: compressed, in base64, and 32-bit thresholds that compare exactly as the 64-bit ones do."""

from __future__ import annotations

import base64
import gzip
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safeswitch.protocols import Array

TYPES = {"uint8": np.uint8, "int16": np.int16, "int32": np.int32, "float32": np.float32}
"""Types of arrays that the page reads, by their names in JavaScript (lower case, without `Array`)."""

GAP = 255
"""Level of a trace after the episode's end."""


class Pack:
    """Arrays in one block of bytes, with a directory."""

    def __init__(self) -> None:
        self.directory: dict[str, list[Any]] = {}
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, name: str, values: Any, kind: str) -> None:
        """Append an array; a value that the type does not hold is an error."""
        exact = np.asarray(values)
        array = exact.astype(TYPES[kind])
        if not np.array_equal(array, exact):
            raise ValueError(f"{name}: {kind} does not hold all of its values")
        padding = -self._size % 4  # typed arrays start at multiples of their item's size
        data = b"\0" * padding + array.astype(array.dtype.newbyteorder("<")).tobytes()
        self.directory[name] = [kind, self._size + padding, array.size]
        self._parts.append(data)
        self._size += len(data)

    def data(self) -> bytes:
        """The block."""
        return b"".join(self._parts)


def to_text(data: bytes) -> str:
    """Compressed and in base64; the same bytes give the same text."""
    return base64.b64encode(gzip.compress(data, 9, mtime=0)).decode("ascii")


def from_text(text: str) -> bytes:
    """What `to_text` was given."""
    return gzip.decompress(base64.b64decode(text))


def json_text(value: Any) -> str:
    """JSON without spaces; NaN and infinities are errors."""
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


class Order:
    """A strictly increasing map of float64 values to float32: any two compare after it as they did before.

    Rounding alone may make neighbours equal, and `signal > threshold` would then lose an alarm; such a value is moved
    up to the next float32.

    Args:
        values: all that are ever compared; -inf and inf map to themselves.
    """

    def __init__(self, values: Array):
        self.values = np.unique(values[np.isfinite(values)])
        self.mapped = self.values.astype(np.float32)
        for index in range(1, len(self.mapped)):
            if self.mapped[index] <= self.mapped[index - 1]:
                self.mapped[index] = np.nextafter(self.mapped[index - 1], np.float32(np.inf))

    def __call__(self, values: Any) -> NDArray[np.float32]:
        """Map values of those that it was made from, of any shape."""
        values = np.asarray(values, float)
        finite = np.isfinite(values)
        if not np.isin(values[finite], self.values).all():
            raise ValueError("a value that the order was not made from")
        place = np.searchsorted(self.values, np.where(finite, values, self.values[0]))
        return np.where(finite, self.mapped[place], values).astype(np.float32)


def records(running: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Steps at which a running maximum rises, and to what: all that decides where a threshold is first passed.

    Args:
        running: (E, T) running maximum, -inf before arming.

    Returns:
        Number of records (E,) of each episode, then step and value of each record, episode after episode.
    """
    before = np.concatenate([np.full((len(running), 1), -np.inf), running[:, :-1]], axis=1)
    rises = running > before
    episode, step = np.nonzero(rises)
    return np.bincount(episode, minlength=len(running)), step, running[episode, step]


def levels(trace: Array, low: float, high: float, logarithmic: bool) -> NDArray[np.uint8]:
    """A trace in 255 levels of its axis, for drawing only; `GAP` where it is NaN."""
    low, high = (np.log(low), np.log(high)) if logarithmic else (low, high)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = ((np.log(trace) if logarithmic else trace) - low) / max(high - low, 1e-300)
    scaled = np.round(np.clip(share, 0, 1) * (GAP - 1))
    return np.where(np.isnan(trace), GAP, scaled).astype(np.uint8)
