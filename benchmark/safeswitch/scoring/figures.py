"""Figures of the suite as small PNG files: the same data give the same bytes, and colours suit the colour-blind.

No pyplot and no global state: every figure is drawn by its own Agg canvas, in matplotlib's default style, so a user's
configuration changes nothing. Success and failure also differ in marker, not in colour alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import ArrayLike, NDArray

from safeswitch.names import unknown
from safeswitch.protocols import Array
from safeswitch.scoring.markdown import standing
from safeswitch.scoring.metrics import PHI, REFERENCES, signal_of

# Okabe & Ito's palette, https://jfly.uni-koeln.de/color/
BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILLION, PURPLE = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip
CYCLE = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILLION, "#666666")
DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)))
GREY = "#999999"
NAMED_RULES = 4
DPI = 110
STYLE = {
    "font.size": 9, "axes.titlesize": 10, "legend.fontsize": 8, "legend.framealpha": 0.9, "axes.grid": True,
    "grid.alpha": 0.25, "grid.linewidth": 0.6, "axes.spines.top": False, "axes.spines.right": False,
    "lines.linewidth": 1.4,
}  # fmt: skip


@contextmanager
def _figure(path: Path, width: float, height: float, rows: tuple[float, ...] = (1.0,)) -> Iterator[tuple[Figure, Any]]:
    """A figure [inch] with panels of these relative heights below one another, written to `path` on leaving."""
    with matplotlib.style.context(["default", STYLE]):
        figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(len(rows), 1, sharex=True, squeeze=False, height_ratios=rows)[:, 0]
        yield figure, axes
        path.parent.mkdir(parents=True, exist_ok=True)
        # Without the version of matplotlib in it, the file depends on the pixels alone.
        figure.savefig(path, metadata={"Software": None}, pil_kwargs={"optimize": True})


def _log_axis(axes: Axes, which: str) -> None:
    """Make an axis ("x" or "y") logarithmic, with plain numbers: 0.1, 0.2, 0.5; the latter two on short ranges."""
    getattr(axes, f"set_{which}scale")("log")
    axis = getattr(axes, f"{which}axis")
    low, high = getattr(axes, f"get_{which}lim")()
    axis.set_minor_locator(LogLocator(subs=(2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    short = high / low < 2000
    axis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}") if short else NullFormatter())


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
    with _figure(path, 7.0, 7.2, rows=(2.4, 1.5, 1.0)) as (figure, (top, middle, bottom)):
        figure.suptitle(title or "Cross-Entropy Method: learning a threshold", fontsize=11)
        _sampled_thresholds(top, iteration, samples, success, (lower, upper), threshold)
        _belief(middle, iteration, np.asarray(log["mu"], float), np.asarray(log["sigma"], float), threshold)
        bottom.plot(iteration, np.asarray(log["reward_sum"], float), "o-", color=BLUE, markersize=3.5)
        if not accepted.all():
            rejected = np.asarray(log["reward_sum"], float)[~accepted]
            bottom.plot(iteration[~accepted], rejected, "x", color=VERMILLION, ms=8, mew=2, label="repeated")
            bottom.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
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
    _log_axis(axes, "y")
    if margins[0] > limits[0]:
        axes.axhspan(limits[0], margins[0], color=BLUE, alpha=0.12, lw=0, label="below the lower margin")
    if margins[1] < limits[1]:
        axes.axhspan(margins[1], limits[1], color=VERMILLION, alpha=0.12, lw=0, label="above the upper margin")
    for mask, marker, colour, label in kinds:
        if np.any(mask):
            axes.plot(x[mask], samples[mask], marker, color=colour, markersize=4, alpha=0.75, ls="none", label=label)
    axes.axhline(threshold, color=BLACK, lw=1.6, label=f"learned threshold {threshold:.3g}")
    axes.set(ylabel="sampled threshold [signal units]")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


def _belief(axes: Axes, iteration: Array, mu: Array, sigma: Array, threshold: float) -> None:
    axes.fill_between(iteration, np.exp(mu - sigma), np.exp(mu + sigma), color=SKY, alpha=0.35, lw=0)
    axes.plot(iteration, np.exp(mu), "o-", color=BLUE, markersize=3.5, label=r"$e^{\mu}$, band $e^{\mu \pm \sigma}$")
    axes.axhline(threshold, color=BLACK, lw=1.0, ls="--")
    _log_axis(axes, "y")
    axes.set(ylabel="CEM's belief")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


def figure_episode(
    signals: Mapping[str, ArrayLike],
    control_dt: float,
    onset: int | None,
    handover: int | None,
    t_first: float | None,
    threshold: float,
    signal_id: str,
    path: Path,
    title: str = "",
) -> Path:
    """One episode's signals over time with t0, the handover, `t*_first` and the threshold.

    Args:
        signals: id -> (T,) in action units, NaN after an early end.
        control_dt: control step [s].
        onset: step t0; None or negative when undisturbed.
        handover: first step of the expert; None or >= T when there is none.
        t_first: `t*_first` [steps]; None, NaN or >= T when blank.
        threshold: of the rule on `signal_id`.
        signal_id: the rule's own signal, drawn bold.
        path: PNG to write.
        title: above the figure.
    """
    if signal_id not in signals:
        raise unknown("signal", signal_id, signals)
    horizon = len(np.asarray(signals[signal_id]))
    time = np.arange(horizon) * control_dt
    switch = handover if handover is not None and 0 <= handover < horizon else None
    with _figure(path, 7.5, 3.4) as (figure, (axes,)):
        others = [name for name in signals if name != signal_id]
        for i, name in enumerate(others):
            colour = [c for c in CYCLE if c != BLUE][i % (len(CYCLE) - 1)]
            axes.plot(time, signals[name], color=colour, ls=DASHES[1 + i % (len(DASHES) - 1)], lw=1.0, label=name)
        axes.plot(time, signals[signal_id], color=BLUE, lw=2.0, label=signal_id)
        axes.axhline(threshold, color=BLACK, lw=1.0, ls=":", label=f"threshold {threshold:.3g}")
        axes.set_xlim(0, horizon * control_dt)
        _log_axis(axes, "y")
        if switch is not None:
            axes.axvspan(switch * control_dt, horizon * control_dt, color=GREEN, alpha=0.12, lw=0)
        events = [
            (onset, r"$t_0$", BLACK, "-"),
            (switch, "handover", GREEN, "-"),
            (t_first, r"$t^*_\mathrm{first}$", VERMILLION, "--"),
        ]
        _mark_events(axes, events, control_dt, horizon)
        axes.set(xlabel="time [s]", ylabel="signal [action units]")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
        figure.suptitle(
            title or ("learner, then expert (shaded)" if switch is not None else "learner alone"), fontsize=10
        )
    return path


def _mark_events(axes: Axes, events: list[tuple[Any, str, str, str]], control_dt: float, horizon: int) -> None:
    """Vertical lines, named above the frame; names of events close together go one above the other."""
    shown = [e for e in events if e[0] is not None and np.isfinite(e[0]) and 0 <= e[0] < horizon]
    taken: list[float] = []
    for step, label, colour, line in sorted(shown, key=lambda event: event[0]):
        level = sum(abs(step - other) < 0.1 * horizon for other in taken)
        taken.append(step)
        axes.axvline(step * control_dt, color=colour, ls=line, lw=1.3)
        position = (step * control_dt, 1.01 + 0.06 * level)
        axes.annotate(label, position, xycoords=axes.get_xaxis_transform(), color=colour, ha="center", va="bottom")


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
    rows = rows.sort_values(["return_mean", "method"], ascending=[False, True], kind="stable")
    with _figure(path, 8.0, 5.0) as (_, (axes,)):
        if protocol == "start":  # there return = autonomy + phi * success, but for steps driven before a failure
            _iso_returns(axes, rows)
        named = _worth_naming(rows)
        rest = rows[~named & (rows["kind"] != "bound")]
        axes.plot(rest["autonomy"], rest["success"], ".", color=GREY, ms=7, alpha=0.8, ls="none", label="other methods")
        _named_points(axes, rows[named])
        axes.set(xlabel="autonomy (share of steps driven by the learner)", ylabel="success")
        axes.set_title(f"{task}, {cell[0]} severity {cell[1]}, protocol {protocol}", loc="left")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, title="method, return")
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


def figure_threshold_sweep(
    thresholds: ArrayLike | Mapping[str, ArrayLike],
    returns: Mapping[str, ArrayLike],
    marks: Mapping[str, float],
    path: Path,
    levels: Mapping[str, float] | None = None,
    title: str = "",
) -> Path:
    """Mean return of a constant threshold, for every threshold and signal, and where each method put its own.

    Args:
        thresholds: (n,) in the signal's units, increasing, or one such array per signal.
        returns: signal -> (n,) mean return.
        marks: method id (`rule@signal`) -> its threshold; marked on the curve of its signal, as a line without one.
        path: PNG to write.
        levels: name -> return of methods without a threshold (learner, expert, ...).
        title: above the figure.
    """
    grids = {name: _grid(thresholds, name) for name in returns}
    with _figure(path, 8.0, 4.4) as (_, (axes,)):
        for i, (name, values) in enumerate(returns.items()):
            axes.plot(grids[name], values, color=CYCLE[i % len(CYCLE)], ls=DASHES[i % len(DASHES)], label=name)
        for i, (name, level) in enumerate((levels or {}).items()):
            axes.axhline(level, color=GREY, lw=0.9, ls=DASHES[i % len(DASHES)], label=f"{name} {level:.2f}")
        shapes: Callable[[int], str] = lambda i: "osD^vPX*"[i % 8]  # noqa: E731
        for i, (method, threshold) in enumerate(marks.items()):
            signal = signal_of(method) or ""
            if signal in returns:
                colour = CYCLE[list(returns).index(signal) % len(CYCLE)]
                height = np.interp(np.log(threshold), np.log(grids[signal]), np.asarray(returns[signal], float))
                axes.plot(threshold, height, shapes(i), color=colour, mec=BLACK, markersize=7, ls="none", label=method)
            else:
                axes.axvline(threshold, color=BLACK, lw=0.9, ls=DASHES[i % len(DASHES)], label=method)
        _log_axis(axes, "x")
        axes.set(xlabel="threshold [signal units]", ylabel="mean return")
        axes.set_title(title, loc="left")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return path


def _grid(thresholds: ArrayLike | Mapping[str, ArrayLike], signal: str) -> Array:
    if not isinstance(thresholds, Mapping):
        return np.asarray(thresholds, float)
    if signal not in thresholds:
        raise unknown("signal", signal, thresholds)
    return np.asarray(thresholds[signal], float)
