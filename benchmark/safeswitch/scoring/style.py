"""How every figure of the suite looks: the same data give the same bytes, and colours suit the colour-blind.

No pyplot and no global state: every figure is drawn by its own Agg canvas, in matplotlib's default style, so a user's
configuration changes nothing. What colour tells, marker or dash tells too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from safeswitch.protocols import Driver

# Okabe & Ito's palette, https://jfly.uni-koeln.de/color/
BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILLION, PURPLE = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip
CYCLE = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILLION, "#666666")
DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)))
GREY = "#999999"
DRIVERS = {Driver.LEARNER: BLUE, Driver.EXPERT: ORANGE}
"""Colour of who drives, in figures and films."""

DPI = 110
STYLE = {
    "font.size": 9, "axes.titlesize": 10, "legend.fontsize": 8, "legend.framealpha": 0.9, "axes.grid": True,
    "grid.alpha": 0.25, "grid.linewidth": 0.6, "axes.spines.top": False, "axes.spines.right": False,
    "lines.linewidth": 1.4,
}  # fmt: skip
BESIDE: dict[str, Any] = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5), "frameon": False}
"""Place of a legend to the right of its axes."""


@contextmanager
def canvas(width: float, height: float, dpi: float = DPI, **options: Any) -> Iterator[Figure]:
    """An empty figure [inch] in the suite's style, for as long as the block lasts; `options` go to the figure."""
    with matplotlib.style.context(["default", STYLE]):
        figure = Figure(figsize=(width, height), dpi=dpi, **options)
        FigureCanvasAgg(figure)
        yield figure


@contextmanager
def sheet(path: Path, width: float, height: float, dpi: float = DPI, **options: Any) -> Iterator[Figure]:
    """The same, written to `path` as PNG on leaving."""
    with canvas(width, height, dpi, **{"layout": "constrained", **options}) as figure:
        yield figure
        path.parent.mkdir(parents=True, exist_ok=True)
        # Without the version of matplotlib in it, the file depends on the pixels alone.
        figure.savefig(path, metadata={"Software": None}, pil_kwargs={"optimize": True})


def stacked(figure: Figure, rows: Sequence[float]) -> Any:
    """Axes of these relative heights below one another, over one horizontal axis."""
    return figure.subplots(len(rows), 1, sharex=True, squeeze=False, height_ratios=rows)[:, 0]


def log_axis(axes: Axes, which: str) -> None:
    """Make an axis ("x" or "y") logarithmic, with plain numbers: 0.1, 0.2, 0.5; the latter two on short ranges."""
    getattr(axes, f"set_{which}scale")("log")
    axis = getattr(axes, f"{which}axis")
    low, high = getattr(axes, f"get_{which}lim")()
    if high / low < 10:  # there may be no power of ten to put a major tick on
        axis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
        axis.set_minor_locator(NullLocator())
    else:
        axis.set_minor_locator(LogLocator(subs=(2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    short = high / low < 2000
    axis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}") if short else NullFormatter())


@dataclass(frozen=True)
class Marks:
    """What happened when in an episode [steps]; None, NaN, negative or >= T: it did not.

    Attributes:
        onset: t0.
        handover: first step of the expert.
        t_first: `t*_first`.
    """

    onset: float | None = None
    handover: float | None = None
    t_first: float | None = None

    def shown(self, horizon: int) -> list[tuple[float, str, str, str]]:
        """(step, label, colour, line style) of what happened within T = `horizon` steps, in order of time."""
        events = [
            (self.onset, r"$t_0$", BLACK, "-"),
            (self.handover, "handover", GREEN, "-"),
            (self.t_first, r"$t^*_\mathrm{first}$", VERMILLION, "--"),
        ]
        happened = [(float(e[0]), *e[1:]) for e in events if e[0] is not None and 0 <= e[0] < horizon]
        return sorted(happened, key=lambda event: event[0])


def mark_events(axes: Axes, marks: Marks, control_dt: float, horizon: int, apart: float = 0.1) -> dict[str, list[Any]]:
    """Vertical lines, named above the frame; names closer than `apart` T to one another go one above the other.

    Returns:
        Label -> the line and its name.
    """
    taken: list[tuple[float, int]] = []
    drawn = {}
    for step, label, colour, line in marks.shown(horizon):
        near = {level for other, level in taken if abs(step - other) < apart * horizon}
        level = min(set(range(len(near) + 1)) - near)
        taken.append((step, level))
        drawn[label] = [
            axes.axvline(step * control_dt, color=colour, ls=line, lw=1.3),
            axes.annotate(
                label, (step * control_dt, 1.0), (0, 2 + 11 * level), color=colour, ha="center", va="bottom",
                xycoords=axes.get_xaxis_transform(), textcoords="offset points",
            ),
        ]  # fmt: skip
    return drawn


def positive(*values: Any) -> bool:
    """Whether all finite values are positive, so that a logarithmic axis can show them."""
    finite = [np.asarray(each, float) for each in values]
    return all(bool((each[np.isfinite(each)] > 0).all()) for each in finite)
