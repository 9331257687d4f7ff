"""Reads a report as the page's script does, in plain Python and apart from the code that wrote it."""

from __future__ import annotations

import base64
import gzip
import json
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

BLOCK = re.compile(r'<script type="text/plain" hidden data-task="([^"]+)" data-part="([^"]+)">([^<]*)</script>')


def tasks_of(page: Path) -> dict[str, Any]:
    """Task -> its bundle, with the arrays under "data"."""
    blocks = {
        (task, part): gzip.decompress(base64.b64decode(text)) for task, part, text in BLOCK.findall(page.read_text())
    }
    found = {}
    for task in dict.fromkeys(task for task, _ in blocks):
        bundle = json.loads(blocks[task, "json"])
        data = blocks[task, "arrays"]
        bundle["data"] = {
            name: np.frombuffer(data, np.dtype(kind).newbyteorder("<"), size, offset)
            for name, (kind, offset, size) in bundle.get("arrays", {}).items()
        }
        found[task] = bundle
    return found


def views(bundle: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Every (cell, protocol, signal) that can be explored."""
    for cell, protocol in bundle["exact"]["views"]:
        for signal in bundle["exact"]["signals"]:
            yield cell, protocol, signal["name"]


def handovers(bundle: dict[str, Any], cell: str, protocol: str, signal: str, thresholds: Sequence[float]) -> np.ndarray:
    """Columns handover, success (2: unknown), learner's steps, onset of every episode, learner after learner."""
    exact, data = bundle["exact"], bundle["data"]
    horizon, rows = exact["horizon"], []
    cells = [cell, exact["none"]] if protocol == "start" and cell != exact["none"] else [cell]
    starts = {name: np.cumsum([0, *data[f"{name}/{protocol}/{signal}/count"]]) for name in cells}
    for place, threshold in enumerate(thresholds):
        for name in cells:
            steps, values = (data[f"{name}/{protocol}/{signal}/{what}"] for what in ("step", "value"))
            count = exact["cells"][name]
            for row in range(place * count, (place + 1) * count):
                handover, length = horizon, int(data[f"{name}/length"][row])
                for index in range(starts[name][row], starts[name][row + 1]):
                    if values[index] > threshold:
                        handover = int(steps[index]) + 1
                        break
                if handover >= length:
                    handover = horizon
                known = data[f"{name}/outcome"][row * (horizon + 1) + handover]
                success = data[f"{name}/alone"][row] if handover >= length else known
                rows.append((handover, int(success), min(handover, length), int(data[f"{name}/onset"][row])))
    return np.array(rows)


def scores(found: np.ndarray, horizon: int, protocol: str) -> dict[str, float]:
    """The leaderboard's columns from `handovers`."""
    handover, success, driven, onset = found.T
    armed = np.maximum(driven - (onset if protocol == "onset" else 0), 0)
    count, disturbed = len(found), onset >= 0
    return {
        "success": success.sum() / count,
        "autonomy": driven.sum() / count / horizon,
        "return_mean": armed.sum() / count / horizon + 5 * success.sum() / count,
        "false_alarms": (handover < horizon)[~disturbed].mean() if (~disturbed).any() else math.nan,
        "false_alarms_before_onset": (handover < onset)[disturbed].mean() if disturbed.any() else math.nan,
    }


def same(written: float, exact: float) -> bool:
    """Whether a number of leaderboard.csv is `exact`, to its six significant digits."""
    if math.isnan(written) or math.isnan(exact):
        return math.isnan(written) and math.isnan(exact)
    return written == exact or abs(written - exact) <= 0.5 * 10.0 ** (math.floor(math.log10(abs(exact))) - 5) * (
        1 + 1e-6
    )


def real(value: float | str | None) -> float:
    """A number of the page's JSON."""
    return math.nan if value is None else float(value)
