"""Figures of single episodes: signals over time with what the learner saw beneath, and a sheet of disturbances."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.offsetbox import AnnotationBbox, OffsetImage
from numpy.typing import ArrayLike, NDArray

from safeswitch.names import unknown
from safeswitch.protocols import Driver
from safeswitch.scoring.style import (
    BESIDE,
    BLACK,
    BLUE,
    CYCLE,
    DASHES,
    DRIVERS,
    Marks,
    log_axis,
    mark_events,
    positive,
    sheet,
    stacked,
)

Image = NDArray[np.uint8]

STRIP_DPI = 160
THUMBNAIL = 128
"""Width of a frame in a figure [pixel]: twice that of a 64 x 64 observation, so that its pixels stay square."""
STRIP_FRAMES = 9
GAP = 8
"""Between the frames of a sheet [pixel]."""
LABEL = 230
"""Width of the text beside a row of a sheet [pixel]."""


@dataclass(frozen=True)
class Strip:
    """Some observations of one episode.

    Attributes:
        label: name of the episode.
        frames: step -> observation (h, w, 3) of that step.
        driver: (T,) `Driver` of each step.
        verdict: how it ended.
    """

    label: str
    frames: Mapping[int, Image]
    driver: NDArray[np.int8]
    verdict: str


def strip_steps(horizon: int, count: int = STRIP_FRAMES) -> list[int]:
    """At most `count` evenly spaced steps of an episode of T = `horizon` steps, each in the middle of its part."""
    stride = -(-horizon // count)
    return list(range(stride // 2, horizon, stride))


def figure_episode(
    signals: Mapping[str, ArrayLike],
    thresholds: Mapping[str, float],
    control_dt: float,
    marks: Marks,
    path: Path,
    title: str = "",
    strips: Sequence[Strip] = (),
) -> Path:
    """One episode's signals over time with t0, the handover, `t*_first`, thresholds and what the learner saw.

    Args:
        signals: id -> (T,), NaN after an early end.
        thresholds: signal id -> threshold of a rule on it; each such signal has a panel of its own. The first one is
            the rule's that hands over. Signals without a threshold are drawn thin in the first panel.
        control_dt: control step [s].
        marks: what happened when.
        path: PNG to write.
        title: above the figure.
        strips: observations beneath the traces, aligned with time.
    """
    for name in thresholds:
        if name not in signals:
            raise unknown("signal", name, signals)
    horizon = len(np.asarray(next(iter(signals.values()))))
    heights = [2.4, *[1.1] * (len(thresholds) - 1)]
    rows = [*heights, *([1.0 * len(strips)] if strips else [])]
    width, dpi = (10.5, STRIP_DPI) if strips else (7.5, 110)
    with sheet(path, width, sum(rows) + 0.9, dpi) as figure:
        every = stacked(figure, rows)
        thin = {name: trace for name, trace in signals.items() if name not in thresholds}
        for i, (axes, (name, threshold)) in enumerate(zip(every, thresholds.items(), strict=False)):
            _draw_traces(axes, name, signals[name], threshold, {} if i else thin, control_dt)
        if strips:
            _draw_strips(every[-1], strips, control_dt)
        for axes in every:
            _draw_marks(axes, marks, control_dt, horizon, first=axes is every[0])
        every[-1].set_xlabel("time [s]")
        figure.align_ylabels(every[: len(thresholds)])
        figure.suptitle(title, fontsize=10)
    return path


def _draw_traces(
    axes: Axes, name: str, trace: ArrayLike, threshold: float, thin: Mapping[str, ArrayLike], control_dt: float
) -> None:
    values = np.asarray(trace, float)
    time = np.arange(len(values)) * control_dt
    colours = [colour for colour in CYCLE if colour != BLUE]
    for i, (other, each) in enumerate(thin.items()):
        dashes = DASHES[1 + i % (len(DASHES) - 1)]
        axes.plot(time, each, color=colours[i % len(colours)], ls=dashes, lw=1.0, label=other)
    axes.plot(time, values, color=BLUE, lw=2.0, label=name)
    axes.axhline(threshold, color=BLACK, lw=1.0, ls=":", label=f"threshold {threshold:.3g}")
    if positive(values, threshold, *thin.values()):
        log_axis(axes, "y")
    axes.set_ylabel("signal")


def _draw_marks(axes: Axes, marks: Marks, control_dt: float, horizon: int, first: bool) -> None:
    """Events across the axes, by name in the first alone, and what comes after the handover shaded."""
    axes.set_xlim(0, horizon * control_dt)
    for line, name in mark_events(axes, marks, control_dt, horizon).values():
        line.set_zorder(4)
        name.set_visible(first)
    if marks.handover is not None and 0 <= marks.handover < horizon:
        label = "after the handover" if first else None
        span = (marks.handover * control_dt, horizon * control_dt)
        axes.axvspan(*span, color=DRIVERS[Driver.EXPERT], alpha=0.12, lw=0, label=label)
    axes.legend(**BESIDE)


def _draw_strips(axes: Axes, strips: Sequence[Strip], control_dt: float) -> None:
    """Frames at their time, each framed in the colour of who drives."""
    axes.set_ylim(len(strips) - 0.5, -0.5)
    axes.set_yticks(range(len(strips)), [strip.label for strip in strips])
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False)
    for row, strip in enumerate(strips):
        for step, frame in strip.frames.items():
            # In pixels of the figure, not of the screen: an observation's pixel stays a square.
            picture = OffsetImage(frame, zoom=THUMBNAIL / frame.shape[1], dpi_cor=False, interpolation="nearest")
            colour = DRIVERS[Driver(int(strip.driver[step]))]
            box = {"edgecolor": colour, "linewidth": 2.5, "facecolor": "white"}
            axes.add_artist(
                AnnotationBbox(picture, (step * control_dt, row), pad=0.0, bboxprops=box, frameon=True, zorder=3)
            ).set_in_layout(False)
        axes.annotate(strip.verdict, (1.01, row), xycoords=("axes fraction", "data"), va="center")
    for driver, colour in DRIVERS.items():
        axes.plot([], [], "s", mfc="white", mec=colour, mew=2.0, label=f"{driver.name.lower()} drives")


def figure_disturbances(
    rows: Mapping[str, tuple[str, Sequence[Image | None]]], columns: Sequence[str], path: Path
) -> Path:
    """A sheet of what the learner sees: one row a disturbance, one column a step.

    Args:
        rows: name -> (sentence, one observation (h, w, 3) per column, None after an early end).
        columns: what stands above each.
        path: PNG to write.
    """
    frame = next(each for _, frames in rows.values() for each in frames if each is not None)
    tall = round(THUMBNAIL * frame.shape[0] / frame.shape[1])
    head = 30
    width = LABEL + len(columns) * (THUMBNAIL + GAP)
    height = head + len(rows) * (tall + GAP)
    with sheet(path, width / 100, height / 100, 100, layout="none") as figure:
        for column, text in enumerate(columns):
            left = LABEL + column * (THUMBNAIL + GAP)
            figure.text((left + THUMBNAIL / 2) / width, 1 - head / 2 / height, text, ha="center", va="center")
        for row, (name, (sentence, frames)) in enumerate(rows.items()):
            top = head + row * (tall + GAP)
            lines = textwrap.fill(sentence, 34)
            figure.text(10 / width, 1 - (top + 22) / height, name, weight="bold", va="center", fontsize=10)
            figure.text(10 / width, 1 - (top + 40) / height, lines, va="top", fontsize=8.5)
            for column, picture in enumerate(frames):
                if picture is None:
                    continue
                place = (LABEL + column * (THUMBNAIL + GAP)) / width, 1 - (top + tall) / height
                axes = figure.add_axes((*place, THUMBNAIL / width, tall / height))
                axes.imshow(picture, interpolation="nearest", aspect="auto")
                axes.set_axis_off()
    return path
