"""The headline that leaves a disturbance out: which rows it takes, and what it compares."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from safeswitch import suite
from safeswitch.scoring import leaderboard
from safeswitch.scoring.left_out import COLUMNS, left_out_lines, left_out_table
from safeswitch.scoring.metrics import OTHERS, TaskInfo

T, INFOS = 50, {"cart-pole": TaskInfo(horizon=50, control_dt=0.1)}
CELLS = ("cart-mass", "push", "none-of-it")
METHODS = ("learner", "oracle-hindsight", "cem@total", "grid@total", "cem-vector", "fixed-q95@total")
LEARNS = ("cem@total", "grid@total", "cem-vector")


def episodes(learners: int = 3, seeds: int = 10) -> pd.DataFrame:
    """Rows in which every calibration of every method has steps and successes of its own; no `OTHERS` in one cell."""
    rng = np.random.default_rng(0)
    learner, seed = (each.ravel() for each in np.meshgrid(np.arange(learners), 100 + np.arange(seeds), indexing="ij"))
    parts = []
    for cell in CELLS:
        alone = rng.random(len(seed)) < 0.5
        for method in METHODS:
            for on in ("", OTHERS) if method in LEARNS and cell != "none-of-it" else ("",):
                steps = rng.integers(5, T, len(seed))
                columns = {
                    "learner": learner, "seed": seed, "disturbed": True, "onset": 5, "arming_step": 5,
                    "handover": steps, "learner_steps": steps, "armed_learner_steps": steps - 5,
                    "success": rng.random(len(seed)) < (1.0 if method == "oracle-hindsight" else 0.7),
                    "learner_success": alone, "t_first": 20.0, "t_last": 20.0, "handovers": 1, "threshold": 0.1,
                    "tuning_episodes": 1, "expert_queries": 0, "task": "cart-pole", "disturbance": cell,
                    "severity": 3, "protocol": "onset", "method": method, "calibrated_on": on,
                }  # fmt: skip
                parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def mean_return(frame: pd.DataFrame, method: str) -> float:
    chosen = frame[(frame["method"] == method) & frame["disturbance"].isin(CELLS[:2])]
    chosen = chosen[chosen["calibrated_on"] == (OTHERS if method in LEARNS else "")]
    return float((chosen["armed_learner_steps"] / T + 5 * chosen["success"]).mean())


def test_learned_thresholds_are_those_from_other_disturbances_and_every_cell_counts_alike() -> None:
    frame = episodes()
    table = left_out_table(frame, INFOS, resamples=100).set_index("method")
    assert set(table.index) == set(METHODS) and (table["cells"] == 2).all()
    for method in METHODS:
        row = table.loc[method]
        assert row["return_mean"] == pytest.approx(mean_return(frame, method))
        assert row["minus_cem"] == pytest.approx(mean_return(frame, method) - mean_return(frame, "cem@total"))
        assert row["return_lo"] <= row["return_mean"] <= row["return_hi"]
        assert row["minus_grid_lo"] <= row["minus_grid"] <= row["minus_grid_hi"]
    assert (table.loc["cem@total", ["minus_cem", "minus_cem_lo", "minus_cem_hi", "gap_closed"]] == 0).all()
    assert table.loc["oracle-hindsight", "gap_closed"] == pytest.approx(1)


def test_the_same_seeds_in_several_cells_are_not_independent() -> None:
    """With both cells alike the pooled interval is that of one of them: no narrower for the repetition."""
    frame = episodes()
    one = frame[frame["disturbance"] == "cart-mass"]
    twice = pd.concat([one, one.assign(disturbance="push")], ignore_index=True)
    tables = [left_out_table(each, INFOS, resamples=200) for each in (one, twice)]
    for name in ("return_mean", "return_lo", "return_hi", "minus_cem_lo"):
        np.testing.assert_allclose(tables[0][name], tables[1][name], atol=1e-12)


def test_without_such_rows_there_is_no_headline() -> None:
    frame = episodes()
    table = left_out_table(frame[frame["calibrated_on"] == ""], INFOS, resamples=10)
    assert table.empty and list(table) == COLUMNS and left_out_lines(table, {}) == []


def test_lines_name_what_a_method_needs_and_always_show_the_rivals() -> None:
    lines = left_out_lines(left_out_table(episodes(), INFOS, resamples=50), {"cem@total": "F R"}, count=1)
    text = "\n".join(lines)
    assert "one disturbance left out" in text and "2 disturbances, 3 learners" in text
    assert "| `cem@total` | F R |" in text and "`grid@total`" in text and "`cem-vector`" in text


def test_rows_of_both_calibrations_stand_beside_one_another() -> None:
    table = leaderboard(episodes(), INFOS, resamples=10)
    both = table[(table["method"] == "cem@total") & (table["disturbance"] == "push")]
    assert both["calibrated_on"].tolist() == ["", OTHERS]


@pytest.mark.parametrize("task", suite.TASKS.values(), ids=lambda task: task.name)
def test_the_other_cells_never_have_the_disturbance(task: suite.Task) -> None:
    for cell in task.cells:
        others = suite.others(cell, task.cells)
        assert all(each.disturbance != cell.disturbance and each.left_out for each in others)
        assert bool(others) == cell.left_out
        assert all(each.complete("calibrate") for each in others)
    assert suite.others(task.paper_cell, task.cells[:3]) == (), "the small profiles have one disturbance that harms"
