"""Figures are drawn, small, the same bytes each time, and show what they are given."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.image import imread

from safeswitch.scoring.figures import (
    figure_cem,
    figure_episode,
    figure_plane,
    figure_threshold_sweep,
    outcome_margins,
)


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


def draw_episode(path: Path) -> Path:
    trace = np.exp(np.random.default_rng(1).normal(-2, 0.3, 100))
    trace[80:] = np.nan
    return figure_episode({"total": trace, "epistemic": trace / 2}, 0.06, 40, 50, 60.0, 0.3, "total", path)


def draw_plane(path: Path) -> Path:
    return figure_plane(board(), "cart-pole", ("cart-mass", 3), "start", path)


def draw_sweep(path: Path) -> Path:
    grid = np.geomspace(0.01, 2, 50)
    returns = {"total": 5 - np.log(grid / 0.2) ** 2 / 5, "epistemic": 5 - np.log(grid / 0.1) ** 2 / 5}
    marks = {"cem@total": 0.2, "fixed-0.4@total": 0.4, "elsewhere": 0.7}
    return figure_threshold_sweep(grid, returns, marks, path, levels={"expert": 5.0})


@pytest.mark.parametrize("draw", [draw_cem, draw_episode, draw_plane, draw_sweep])
def test_figure_is_not_blank_small_and_reproducible(draw: Callable[[Path], Path], tmp_path: Path) -> None:
    path = draw(tmp_path / "new" / "figure.png")
    image = imread(path)[..., :3]
    inked = (image < 0.95).any(axis=2)
    assert min(image.shape[:2]) > 300
    assert 0.01 < inked.mean() < 0.9
    thirds = [part.any() for strip in np.array_split(inked, 3) for part in np.array_split(strip, 3, axis=1)]
    assert sum(thirds) >= 8  # drawn all over, not in a corner
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 20
    assert path.stat().st_size < 150_000
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
    figure_episode({"total": trace}, 0.1, None, 30, float("nan"), 0.3, "total", tmp_path / "a.png")


def test_unknown_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown signal 'totl'; valid, nearest first: total"):
        figure_episode({"total": np.ones(9)}, 0.1, 1, 2, 3.0, 0.1, "totl", tmp_path / "a.png")
    with pytest.raises(ValueError, match="no rows for cart-pole, push severity 3"):
        figure_plane(board(), "cart-pole", ("push", 3), "start", tmp_path / "a.png")
    with pytest.raises(ValueError, match="unknown signal"):
        figure_threshold_sweep({"total": [0.1, 1]}, {"epistemic": [1, 2]}, {}, tmp_path / "a.png")
