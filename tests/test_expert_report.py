"""The report on the rally car's expert: its tables obey their laws, and what it claims can be driven again."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from safeswitch import expert_report
from safeswitch.expert_report import Timed, avoidance, laps, make_car, report, timing
from safeswitch.handover.episode import continue_with_expert
from safeswitch.tasks.track import TRACKS

pytestmark = pytest.mark.rendering
SEEDS = range(1_000_000, 1_000_006)


@cache
def near_and_far() -> tuple[list[dict[str, float]], list[Timed]]:
    experts: list[Timed] = []
    return avoidance("rally-car-image", "ridge", 4.0, (0.4, 1.5, 3.0), SEEDS, experts), experts


def test_a_lap_is_driven_in_the_middle() -> None:
    experts: list[Timed] = []
    row = laps("rally-car-image", "hollow", 4.0, 1, experts)
    assert row["laps"] == row["asked"] == 1
    assert 0 < row["mean_offset"] < row["largest_offset"] < 0.05
    steps = len(experts[0].warm)
    assert len(experts[0].cold) == 1 and steps == pytest.approx(TRACKS["hollow"].length / (4.0 * 0.05), rel=0.05)


def test_obstacles_are_avoided_from_afar_and_not_at_the_bumper() -> None:
    rows, experts = near_and_far()
    assert [row["distance"] for row in rows] == [0.4, 1.5, 3.0]
    assert all(0 <= row["lo"] <= row["share"] <= row["hi"] <= 1 for row in rows)
    assert {row["trials"] for row in rows} == {rows[0]["trials"]} and rows[0]["trials"] > 0
    assert rows[0]["share"] < 0.5 < rows[-1]["share"] == 1.0
    assert len(experts[0].cold) == 3 * rows[0]["trials"]  # every handover starts cold


def test_what_is_avoided_would_have_been_hit() -> None:
    """The approach is a failure to its end, and its gaps shrink in steps of the speed."""
    env = make_car("rally-car-image", disturbance="obstacle", severity=3)
    blind = env.make_expert()
    approach = next(found for seed in SEEDS if (found := expert_report._approach(env, blind, seed)) is not None)
    snapshots, gaps = approach
    np.testing.assert_allclose(np.diff(gaps), -0.2, atol=0.1)
    assert abs(gaps[-1]) < 0.7
    env.restore(snapshots[0])
    assert continue_with_expert(env, env.make_expert())


def test_timing_counts_every_step() -> None:
    experts = near_and_far()[1]
    rows = timing(experts)
    assert [row["step"] for row in rows] == ["cold", "warm"]
    assert rows[0]["steps"] == len(experts[0].cold) and rows[1]["steps"] == len(experts[0].warm)
    for row in rows:
        assert 0 < row["p50_ms"] <= row["p95_ms"] <= row["p99_ms"] <= row["longest_ms"]


def test_bad_input_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"rally-car-imag.*rally-car-image"):
        make_car("rally-car-imag")
    with pytest.raises(ValueError, match="at least 1, got 0 and 5"):
        report("rally-car-image", tmp_path, 0, 5)


@pytest.mark.slow
@pytest.mark.parametrize("task", expert_report.ENV_IDS)
def test_report_writes_tables_and_figure(task: str, tmp_path: Path) -> None:
    tables = report(task, tmp_path, 1, 4)
    for name, table in tables.items():
        pd.testing.assert_frame_equal(pd.read_csv(tmp_path / f"{name}.csv"), table, rtol=1e-4, check_dtype=False)
    assert (tmp_path / "avoidance.png").read_bytes().startswith(b"\x89PNG")
    cells = len(TRACKS) * len(expert_report.SPEEDS)
    assert len(tables["laps"]) == cells and len(tables["avoidance"]) == cells * len(expert_report.DISTANCES)
    assert (tables["laps"]["laps"] == 1).all()
    far = tables["avoidance"][tables["avoidance"]["distance"] == 4.0]
    assert (far["share"] == 1.0).all()
