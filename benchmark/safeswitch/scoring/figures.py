"""Figures about methods and signals: CEM's learning, success against autonomy, thresholds, signal quality."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from safeswitch.names import unknown
from safeswitch.protocols import Array
from safeswitch.scoring.markdown import standing
from safeswitch.scoring.metrics import PHI, REFERENCES, signal_of
from safeswitch.scoring.style import (
    BESIDE,
    BLACK,
    BLUE,
    DASHES,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    YELLOW,
    log_axis,
    positive,
    sheet,
    stacked,
)

NAMED_RULES = 4
COLUMNS = 4
"""Small multiples beside one another."""


def outcome_margins(samples: ArrayLike, success: ArrayLike) -> tuple[float, float]:
    """The thresholds between which outcomes change, from sampled thresholds and their success.

    Args:
        samples: thresholds, any shape.
        success: share of episodes that succeeded with each, same shape, in [0, 1].

    Returns:
        (lower, upper): below or at `lower` every sample succeeded always, at or above `upper` none did always;
        -inf and inf where there is no such sample. lower < upper.
    """
    theta, always = np.ravel(np.asarray(samples, float)), np.ravel(np.asarray(success, float)) >= 1
    theta, always = theta[np.isfinite(theta)], always[np.isfinite(theta)]
    first_failure = theta[~always].min(initial=np.inf)
    last_success = theta[always].max(initial=-np.inf)
    below, above = theta[theta < first_failure], theta[theta > last_success]
    return float(below.max(initial=-np.inf)), float(above.min(initial=np.inf))


def figure_cem(
    log: Mapping[str, Any], margins: tuple[float, float] | None, threshold: float, path: Path, title: str = ""
) -> Path:
    """Figure 1 of the paper: how the Cross-Entropy Method learned a threshold.

    Args:
        log: `samples`, `sample_success` in [0, 1] and `sample_return`, each (iterations, candidates); `mu` and `sigma`
            (iterations,) of the logarithm of the threshold; `reward_sum` (iterations,); `accepted` (iterations,) bool.
        margins: thresholds between which one is worth having (NaN or infinite: none on that side); None takes
            `outcome_margins` of the samples.
        threshold: the learned one, mu*, in the signal's units.
        path: PNG to write.
        title: above the figure.
    """
    samples, success = np.asarray(log["samples"], float), np.asarray(log["sample_success"], float)
    iteration = np.arange(1.0, len(samples) + 1)
    accepted = np.asarray(log.get("accepted", np.ones(len(samples))), bool)
    lower, upper = outcome_margins(samples, success) if margins is None else margins
    with sheet(path, 7.0, 7.2) as figure:
        top, middle, bottom = stacked(figure, (2.4, 1.5, 1.0))
        figure.suptitle(title or "Cross-Entropy Method: learning a threshold", fontsize=11)
        _sampled_thresholds(top, iteration, samples, success, (lower, upper), threshold)
        _belief(middle, iteration, np.asarray(log["mu"], float), np.asarray(log["sigma"], float), threshold)
        bottom.plot(iteration, np.asarray(log["reward_sum"], float), "o-", color=BLUE, markersize=3.5)
        if not accepted.all():
            rejected = np.asarray(log["reward_sum"], float)[~accepted]
            bottom.plot(iteration[~accepted], rejected, "x", color=VERMILLION, ms=8, mew=2, label="repeated")
            bottom.legend(**BESIDE)
        bottom.set(xlabel="iteration", ylabel="sum of rewards")
        bottom.set_xlim(0.4, len(samples) + 0.6)
        bottom.xaxis.set_major_locator(MaxNLocator(integer=True))
    return path


def _sampled_thresholds(
    axes: Axes, iteration: Array, samples: Array, success: Array, margins: tuple[float, float], threshold: float
) -> None:
    x = np.broadcast_to(iteration[:, None], samples.shape)
    all_good, all_bad = success >= 1, success <= 0
    kinds: list[tuple[NDArray[np.bool_], str, str, str]] = [
        (all_good, "o", BLUE, "every episode succeeded"),
        (~all_good & ~all_bad, "D", ORANGE, "some failed"),
        (all_bad, "x", VERMILLION, "every episode failed" if (~all_good & ~all_bad).any() else "failed"),
    ]
    values = np.concatenate([samples[np.isfinite(samples) & (samples > 0)], [threshold]])
    limits = (values.min() / 1.25, values.max() * 1.25)
    axes.set_ylim(*limits)
    log_axis(axes, "y")
    if margins[0] > limits[0]:
        axes.axhspan(limits[0], margins[0], color=BLUE, alpha=0.12, lw=0, label="below the lower margin")
    if margins[1] < limits[1]:
        axes.axhspan(margins[1], limits[1], color=VERMILLION, alpha=0.12, lw=0, label="above the upper margin")
    for mask, marker, colour, label in kinds:
        if np.any(mask):
            axes.plot(x[mask], samples[mask], marker, color=colour, markersize=4, alpha=0.75, ls="none", label=label)
    axes.axhline(threshold, color=BLACK, lw=1.6, label=f"learned threshold {threshold:.3g}")
    axes.set(ylabel="sampled threshold [signal units]")
    axes.legend(**BESIDE)


def _belief(axes: Axes, iteration: Array, mu: Array, sigma: Array, threshold: float) -> None:
    axes.fill_between(iteration, np.exp(mu - sigma), np.exp(mu + sigma), color=SKY, alpha=0.35, lw=0)
    axes.plot(iteration, np.exp(mu), "o-", color=BLUE, markersize=3.5, label=r"$e^{\mu}$, band $e^{\mu \pm \sigma}$")
    axes.axhline(threshold, color=BLACK, lw=1.0, ls="--")
    log_axis(axes, "y")
    axes.set(ylabel="CEM's belief")
    axes.legend(**BESIDE)


def figure_plane(
    table: pd.DataFrame, task: str, cell: tuple[str, int], protocol: str, path: Path, privileged: tuple[str, ...] = ()
) -> Path:
    """Success against autonomy of every method of one cell.

    Named, and drawn with the interval of success, are references, bounds, the paper's rule and the rules with the
    highest return; the rest are dots.

    Args:
        table: what `leaderboard` returns.
        task: for example "cart-pole".
        cell: (disturbance, severity).
        protocol: "onset" or "start".
        path: PNG to write.
        privileged: further methods drawn as bounds.
    """
    chosen = (table["task"] == task) & (table["disturbance"] == cell[0]) & (table["severity"] == cell[1])
    rows = table[chosen & (table["protocol"] == protocol)]
    if rows.empty:
        raise ValueError(f"the leaderboard has no rows for {task}, {cell[0]} severity {cell[1]}, protocol {protocol!r}")
    rows = rows.assign(kind=[standing(name, privileged) for name in rows["method"]])
    rows = rows[rows["kind"] != "share"]  # thresholds for an expert share, whatever they earn: a table of their own
    rows = rows.sort_values(["return_mean", "method"], ascending=[False, True], kind="stable")
    with sheet(path, 8.0, 5.0) as figure:
        axes = figure.subplots()
        if protocol == "start":  # there return = autonomy + phi * success, but for steps driven before a failure
            _iso_returns(axes, rows)
        named = _worth_naming(rows)
        rest = rows[~named & (rows["kind"] != "bound")]
        axes.plot(rest["autonomy"], rest["success"], ".", color=GREY, ms=7, alpha=0.8, ls="none", label="other methods")
        _named_points(axes, rows[named])
        axes.set(xlabel="autonomy (share of steps driven by the learner)", ylabel="success")
        axes.set_title(f"{task}, {cell[0]} severity {cell[1]}, protocol {protocol}", loc="left")
        axes.legend(**BESIDE, title="method, return")
    return path


LOOKS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "rule": ("oDPXhH", (BLUE, VERMILLION, PURPLE, SKY, YELLOW, ORANGE)),
    "give-back": ("d", (PURPLE,)),
    "control": ("v", (ORANGE,)),
    "reference": ("s<>", (BLACK,)),
    "bound": ("^*p", (GREEN,)),
}
"""Standing of a method -> its markers and colours, one after the other."""


def _named_points(axes: Axes, rows: pd.DataFrame) -> None:
    """Each with its own marker, the interval of success, and a line in the legend, highest return first."""
    place = rows.groupby("kind").cumcount()
    for i, (_, row) in zip(place, rows.iterrows(), strict=True):
        markers, colours = LOOKS[row["kind"]]
        colour = colours[i % len(colours)]
        axes.vlines(row["autonomy"], row["success_lo"], row["success_hi"], color=colour, lw=0.8, alpha=0.8)
        axes.plot(
            row["autonomy"], row["success"], markers[i % len(markers)], color=colour, mec=BLACK, mew=0.5, ms=7.5,
            alpha=0.9, ls="none", label=f"{row['method']}, {row['return_mean']:.2f}",
        )  # fmt: skip


def _iso_returns(axes: Axes, rows: pd.DataFrame) -> None:
    autonomy = np.array([-0.02, 1.02])
    levels = np.arange(0.0, PHI + 1.01, 0.5)
    for level in levels[levels <= rows["return_mean"].max() + 0.5]:
        axes.plot(autonomy, (level - autonomy) / PHI, color=GREY, lw=0.5, ls=":", zorder=0)
    axes.plot([], [], color=GREY, lw=0.8, ls=":", label=f"equal return, phi = {PHI:g}")
    lowest = float(rows["success_lo"].min())
    axes.set_ylim(max(lowest - 0.05, -0.02), 1.02)
    axes.set_xlim(-0.03, 1.03)


def _worth_naming(rows: pd.DataFrame) -> NDArray[np.bool_]:
    """Mask: references, oracles, the paper's rule, and the first of each kind; rows are sorted by return."""
    named = rows["method"].isin([*REFERENCES, "cem@total", "best@total", "oracle-hindsight", "oracle-onset"])
    place = rows.groupby("kind").cumcount()
    return (named | (place == 0) | ((rows["kind"] == "rule") & (place < NAMED_RULES))).to_numpy()


RULE_MARKERS = "osD^vPX*"


def figure_threshold_sweep(
    thresholds: Mapping[str, ArrayLike],
    returns: Mapping[str, ArrayLike],
    marks: Mapping[str, float],
    path: Path,
    levels: Mapping[str, float] | None = None,
    title: str = "",
    strong: Sequence[str] = (),
) -> Path:
    """Mean return of a constant threshold, one panel a signal, and where each method put its own threshold.

    Args:
        thresholds: signal -> (n,) in the signal's units, increasing.
        returns: signal -> (n,) mean return; for the same signals.
        marks: method id (`rule@signal`) -> its threshold; marked on the curve of its signal.
        path: PNG to write.
        levels: name -> return of methods without a threshold (learner, expert, ...).
        title: above the figure.
        strong: signals that come first and in colour; the others in grey.
    """
    for signal in [*strong, *returns, *(signal_of(method) for method in marks)]:
        if signal not in returns or signal not in thresholds:
            raise unknown("signal", str(signal), returns if signal not in returns else thresholds)
    names = list(dict.fromkeys([*strong, *returns]))
    rules = list(dict.fromkeys(method.partition("@")[0] for method in marks))
    columns = min(COLUMNS, len(names))
    count = -(-len(names) // columns)
    with sheet(path, 2.3 * columns + 1.4, 1.9 * count + 0.7) as figure:
        every = figure.subplots(count, columns, sharey=True, squeeze=False)
        for axes, name in zip(every.flat, names, strict=False):
            _sweep_panel(axes, np.asarray(thresholds[name], float), np.asarray(returns[name], float), levels or {})
            axes.lines[0].set_color(BLUE if name in strong else GREY)
            axes.set_title(name, loc="left", fontweight="bold" if name in strong else "normal")
            for method, threshold in marks.items():
                if signal_of(method) == name:
                    place = rules.index(method.partition("@")[0])
                    _mark_threshold(axes, threshold, RULE_MARKERS[place % len(RULE_MARKERS)])
        for axes in every.flat[len(names) :]:
            axes.set_axis_off()
        for place, rule in enumerate(rules):  # for the legend alone
            every[0, 0].plot([], [], RULE_MARKERS[place % len(RULE_MARKERS)], color=ORANGE, mec=BLACK, label=rule)
        figure.legend(*every[0, 0].get_legend_handles_labels(), loc="outside right upper", frameon=False)
        figure.supxlabel("threshold [signal units]", fontsize=9)
        figure.supylabel("mean return", fontsize=9)
        figure.suptitle(title, fontsize=10)
    return path


def _sweep_panel(axes: Axes, grid: Array, values: Array, levels: Mapping[str, float]) -> None:
    axes.plot(grid, values)
    for i, (name, level) in enumerate(levels.items()):
        axes.axhline(level, color=BLACK, lw=0.8, ls=DASHES[1 + i % (len(DASHES) - 1)], label=f"{name} {level:.2f}")
    axes.set_xlim(grid[0], grid[-1])
    if positive(grid):
        log_axis(axes, "x")


def _mark_threshold(axes: Axes, threshold: float, marker: str) -> None:
    """On the curve that the axes already hold; at the edge where the threshold lies beyond it."""
    grid, values = (np.asarray(each, float) for each in axes.lines[0].get_data())
    x = float(np.clip(threshold, grid[0], grid[-1]))
    axes.plot(x, np.interp(x, grid, values), marker, color=ORANGE, mec=BLACK, ms=6.5, ls="none", clip_on=False)


def figure_signals(
    table: pd.DataFrame,
    task: str,
    disturbances: Mapping[str, str],
    path: Path,
    severity: int = 3,
    strong: Collection[str] = (),
) -> Path:
    """How well every signal tells disturbed from undisturbed frames, one panel a disturbance.

    Args:
        table: what `signal_table` returns.
        task: for example "cart-pole".
        disturbances: name -> title of its panel, in order; those without rows are left out.
        path: PNG to write.
        severity: of the disturbances.
        strong: signals in colour; the others in grey.
    """
    rows = table[(table["task"] == task) & (table["severity"] == severity)]
    shown = [name for name in disturbances if (rows["disturbance"] == name).any()]
    if not shown:
        raise ValueError(f"the signal table has no rows for {task}, severity {severity}, {list(disturbances)}")
    first = rows[rows["disturbance"] == shown[0]].sort_values(["frame_auroc", "signal"], kind="stable")
    order = first["signal"].tolist()  # by the first disturbance, best on top
    columns = min(COLUMNS, len(shown))
    count = -(-len(shown) // columns)
    with sheet(path, 1.9 * columns + 1.6, (0.19 * len(order) + 0.45) * count + 0.7) as figure:
        every = figure.subplots(count, columns, sharex=True, sharey=True, squeeze=False)
        for axes, name in zip(every.flat, shown, strict=False):
            _signal_dots(axes, rows[rows["disturbance"] == name], order, strong)
            axes.set_title(disturbances[name], loc="left", fontsize=9)
        for axes in every.flat[len(shown) :]:
            axes.set_axis_off()
        note = "frame AUROC: median and range over learners (dashed: chance; diamonds: signals of the other figures)"
        figure.supxlabel(note, fontsize=9)
        figure.suptitle(f"{task}, severity {severity}: disturbed against undisturbed frames", fontsize=10)
    return path


def _signal_dots(axes: Axes, rows: pd.DataFrame, order: Sequence[str], strong: Collection[str]) -> None:
    """Median and range of each signal, at its place in `order`, lowest first."""
    axes.axvline(0.5, color=BLACK, lw=0.8, ls="--")
    for place, signal in enumerate(order):
        for _, row in rows[rows["signal"] == signal].iterrows():
            colour, size = (BLUE, 5.5) if signal in strong else ("#666666", 4.0)
            axes.hlines(place, row["frame_auroc_min"], row["frame_auroc_max"], color=colour, lw=1.6, alpha=0.6)
            axes.plot(row["frame_auroc"], place, "D" if signal in strong else "o", color=colour, ms=size)
    axes.set_yticks(range(len(order)), order)
    axes.set_ylim(-0.7, len(order) - 0.3)
    axes.set_xlim(-0.03, 1.03)
    axes.set_xticks([0.0, 0.5, 1.0], ["0", "0.5", "1"])
