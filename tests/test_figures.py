"""Figures are drawn, small, the same bytes each time, and show what they are given."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.image import imread

from safeswitch.protocols import Driver
from safeswitch.scoring.episode_figures import Strip, figure_disturbances, figure_episode, strip_steps
from safeswitch.scoring.figures import (
    figure_cem,
    figure_plane,
    figure_signals,
    figure_threshold_sweep,
    outcome_margins,
)
from safeswitch.scoring.style import DRIVERS, Marks


def cem_log(iterations: int = 6, candidates: int = 10) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    samples = np.exp(rng.normal(-1, np.linspace(1, 0.1, iterations)[:, None], (iterations, candidates)))
    success = np.where(samples < 0.4, 1.0, np.where(samples < 0.6, 0.5, 0.0))
    return {
        "samples": samples, "sample_success": success, "sample_return": 5 * success, "mu": np.log(samples).mean(1),
        "sigma": np.log(samples).std(1), "reward_sum": (5 * success).sum(1), "accepted": np.arange(iterations) != 2,
    }  # fmt: skip


def board() -> pd.DataFrame:
    methods = ["learner", "expert", "timer", "cem@total", "best@total", "shuffled@total"]
    methods += [f"m{i}@x" for i in range(9)]
    success = np.linspace(0.5, 0.98, len(methods))
    return pd.DataFrame(
        {
            "task": "cart-pole", "disturbance": "cart-mass", "severity": 3, "protocol": "start", "method": methods,
            "success": success, "success_lo": success - 0.1, "success_hi": np.minimum(success + 0.1, 1),
            "autonomy": np.linspace(0.9, 0.1, len(methods)), "return_mean": 5 * success + 0.5,
        }
    )  # fmt: skip


def draw_cem(path: Path) -> Path:
    return figure_cem(cem_log(), None, 0.35, path, title="CEM")


def signals() -> dict[str, Any]:
    trace = np.exp(np.random.default_rng(1).normal(-2, 0.3, 100))
    trace[80:] = np.nan
    return {"total": trace, "epistemic": trace / 2, "distance": 300 * trace - 40}


def strips() -> list[Strip]:
    """Two episodes of 100 steps: the learner alone, which ends at step 80, and an expert from step 50 on."""
    rng = np.random.default_rng(2)
    frames = {step: rng.integers(0, 256, (64, 64, 3), dtype=np.uint8) for step in strip_steps(100)}
    alone, saved = np.zeros(100, np.int8), np.zeros(100, np.int8)
    alone[80:], saved[50:] = -1, Driver.EXPERT
    early = {step: frame for step, frame in frames.items() if step < 80}
    return [Strip("learner", early, alone, "failure"), Strip("rule", frames, saved, "success")]


def draw_episode(path: Path) -> Path:
    return figure_episode(signals(), {"total": 0.3, "distance": 30.0}, 0.06, Marks(40, 50, 60.0), path)


def draw_strips(path: Path) -> Path:
    return figure_episode(signals(), {"total": 0.3}, 0.06, Marks(40, 50, 60.0), path, strips=strips())


def draw_plane(path: Path) -> Path:
    return figure_plane(board(), "cart-pole", ("cart-mass", 3), "start", path)


NAMES = ("total", "epistemic", "distance", *(f"other-{i}" for i in range(8)))


def draw_sweep(path: Path) -> Path:
    grids = {name: np.geomspace(0.01, 2, 50) * (100 if name == "distance" else 1) for name in NAMES}
    grids["other-0"] = np.linspace(-3, 4, 50)  # a log-likelihood may be negative
    returns = {name: 5 - np.linspace(-1, 1, 50) ** 2 * (i + 1) / 5 for i, name in enumerate(NAMES)}
    marks = {"cem@total": 0.2, "fixed-0.4@total": 0.4, "cem@distance": 20.0, "cem@epistemic": 99.0}
    return figure_threshold_sweep(grids, returns, marks, path, {"expert": 5.0}, strong=("total", "distance"))


def quality() -> pd.DataFrame:
    rows = [
        {"task": "cart-pole", "disturbance": disturbance, "severity": 3, "signal": name, "frame_auroc": value,
         "frame_auroc_min": value - 0.1, "frame_auroc_max": min(value + 0.05, 1.0)}
        for k, disturbance in enumerate(("object", "push", "repaint", "noise", "light"))
        for name, value in zip(NAMES, np.linspace(0.4, 1.0 - 0.05 * k, len(NAMES)), strict=True)
    ]  # fmt: skip
    return pd.DataFrame(rows)


def draw_signals(path: Path) -> Path:
    titles = {"object": "object (the paper's)", "push": "push", "repaint": "repaint (benign)", "noise": "noise",
              "light": "light", "absent": "absent"}  # fmt: skip
    return figure_signals(quality(), "cart-pole", titles, path, strong=("total",))


def draw_sheet(path: Path) -> Path:
    rng = np.random.default_rng(3)
    frames = [rng.integers(0, 256, (64, 64, 3), dtype=np.uint8) for _ in range(3)]
    rows = {"object, severity 3": ("an object", [*frames, None]), "light, severity 3": ("less", [frames[0]] * 4)}
    return figure_disturbances(rows, ["before", "$t_0$", "later", "last"], path)


FIGURES = [draw_cem, draw_episode, draw_strips, draw_plane, draw_sweep, draw_signals, draw_sheet]


@pytest.mark.parametrize("draw", FIGURES)
def test_figure_is_not_blank_small_and_reproducible(draw: Callable[[Path], Path], tmp_path: Path) -> None:
    path = draw(tmp_path / "new" / "figure.png")
    image = imread(path)[..., :3]
    inked = (image < 0.95).any(axis=2)
    assert min(image.shape[:2]) > 300
    assert 0.01 < inked.mean() < 0.9
    thirds = [part.any() for strip in np.array_split(inked, 3) for part in np.array_split(strip, 3, axis=1)]
    assert sum(thirds) >= 8  # drawn all over, not in a corner
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 20
    assert path.stat().st_size < 400_000  # random pictures do not compress
    assert draw(tmp_path / "again.png").read_bytes() == path.read_bytes()


def test_figures_leave_the_global_style_alone(tmp_path: Path) -> None:
    import matplotlib

    before = dict(matplotlib.rcParams)
    draw_plane(tmp_path / "a.png")
    assert dict(matplotlib.rcParams) == before


def test_a_users_style_changes_nothing(tmp_path: Path) -> None:
    import matplotlib

    plain = draw_sweep(tmp_path / "a.png").read_bytes()
    with matplotlib.rc_context({"font.size": 20, "axes.facecolor": "black"}):
        assert draw_sweep(tmp_path / "b.png").read_bytes() == plain


def test_margins_enclose_the_change_of_outcome() -> None:
    assert outcome_margins([0.1, 0.2, 0.5, 0.9], [1, 1, 0, 0]) == (0.2, 0.5)
    assert outcome_margins([0.1, 0.2, 0.3, 0.5, 0.9], [1, 0, 1, 0.5, 0]) == (0.1, 0.5)
    assert outcome_margins([0.1, 0.2], [1, 1]) == (0.2, np.inf)
    assert outcome_margins([0.1, 0.2], [0, 0]) == (-np.inf, 0.1)


@pytest.mark.parametrize("margins", [(float("nan"), float("nan")), (-np.inf, np.inf)])
def test_cem_figure_takes_any_margins(margins: tuple[float, float], tmp_path: Path) -> None:
    assert figure_cem(cem_log(3, 5), margins, 0.3, tmp_path / "a.png").stat().st_size > 10_000


def test_undisturbed_episode_without_handover(tmp_path: Path) -> None:
    trace = np.full(30, 0.1)
    marks = Marks(None, 30, float("nan"))
    figure_episode({"total": trace}, {"total": 0.3}, 0.1, marks, tmp_path / "a.png")
    assert marks.shown(30) == []


def test_events_come_in_order_of_time_and_only_if_they_happened() -> None:
    assert [step for step, *_ in Marks(40, 20, 60.0).shown(80)] == [20, 40, 60]
    assert [label for _, label, *_ in Marks(-1, 80, 12.0).shown(80)] == [r"$t^*_\mathrm{first}$"]


@pytest.mark.parametrize(("step", "drivers"), [(6, "LL"), (54, "LE"), (90, "E")])
def test_strip_shows_every_pixel_of_a_frame_and_who_drives(step: int, drivers: str, tmp_path: Path) -> None:
    image = (imread(draw_strips(tmp_path / "a.png"))[..., :3] * 255).round().astype(int)
    frame = strips()[1].frames[step]
    part = np.kron(frame[:4, 16:24], np.ones((2, 2, 1), int))  # each pixel is a square of 2 x 2
    rows, columns = np.nonzero((image == part[0, 0]).all(axis=2))
    found = [
        (row, column) for row, column in zip(rows, columns, strict=True)
        if np.array_equal(image[row : row + 8, column : column + 16], part)
    ]  # fmt: skip
    assert len(found) == len(drivers)  # nothing after the early end
    for (row, column), letter in zip(found, drivers, strict=True):
        colour = DRIVERS[Driver.LEARNER if letter == "L" else Driver.EXPERT]
        edge = image[row + 60, column - 32 - 3 : column - 32]
        expected = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        assert (np.abs(edge - expected) < 3).all(axis=1).any()


def test_strip_steps_are_evenly_spaced() -> None:
    for horizon in (5, 80, 100, 200):
        steps = strip_steps(horizon)
        assert 0 <= steps[0] and steps[-1] < horizon and len(steps) <= 9
        assert len(set(np.diff(steps))) == 1


def test_every_signal_has_its_own_axis(tmp_path: Path) -> None:
    from matplotlib.figure import Figure

    drawn: list[Any] = []
    save = Figure.savefig

    def keep(figure: Figure, *arguments: Any, **options: Any) -> Any:
        drawn.append([(axes.get_title(loc="left"), axes.get_xlim(), axes.get_xscale()) for axes in figure.axes])
        return save(figure, *arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", keep)
        draw_sweep(tmp_path / "a.png")
    panels = {title: (limits, scale) for title, limits, scale in drawn[0] if title}
    assert list(panels)[:3] == ["total", "distance", "epistemic"] and set(panels) == set(NAMES)
    assert panels["distance"][0] == pytest.approx((1.0, 200.0)) and panels["total"][0] == pytest.approx((0.01, 2.0))
    assert panels["other-0"] == ((-3.0, 4.0), "linear") and panels["other-1"][1] == "log"


def test_unknown_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown signal 'totl'; valid, nearest first: total"):
        figure_episode({"total": np.ones(9)}, {"totl": 0.1}, 0.1, Marks(1, 2, 3.0), tmp_path / "a.png")
    with pytest.raises(ValueError, match="no rows for cart-pole, push severity 3"):
        figure_plane(board(), "cart-pole", ("push", 3), "start", tmp_path / "a.png")
    with pytest.raises(ValueError, match="unknown signal"):
        figure_threshold_sweep({"total": [0.1, 1]}, {"epistemic": [1, 2]}, {}, tmp_path / "a.png")
    with pytest.raises(ValueError, match="unknown signal 'totl'"):
        figure_threshold_sweep({"total": [0.1, 1]}, {"total": [1, 2]}, {"cem@totl": 1.0}, tmp_path / "a.png")
    with pytest.raises(ValueError, match="no rows for cart-pole, severity 3"):
        figure_signals(quality(), "cart-pole", {"absent": "absent"}, tmp_path / "a.png")
