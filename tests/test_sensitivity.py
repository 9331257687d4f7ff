"""What results hang on: thresholds learned again with one thing changed, other K, and the time of a decision."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from micro import MICRO, TASK
from safeswitch.files import load_frame
from safeswitch.pipeline import Run
from safeswitch.scoring.leaderboard import leaderboard
from safeswitch.scoring_stages import GIVE_BACK_SEEDS
from safeswitch.sensitivity import CEM_CHANGES, COUNTS, LEARNING, PHIS, SAMPLES, first_episodes, sensitivity_table
from safeswitch.stages import concat
from safeswitch.store import Store
from safeswitch_baselines.rules.cem import CEM
from synthetic import random_calibration


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    root: Path = tmp_path_factory.mktemp("store")
    return Run(TASK, replace(MICRO, sensitivity=1), Store(root), 1)


@pytest.fixture(scope="module")
def table(run: Run) -> pd.DataFrame:
    return sensitivity_table(run.store, run.task, run.task_info, run.varied[:-1])


def test_every_change_has_a_row_with_its_interval_under_both_armings(table: pd.DataFrame) -> None:
    for protocol in ("onset", "start"):
        rows = table[table["protocol"] == protocol]
        for parameter, changes in CEM_CHANGES.items():
            values = rows.loc[rows["parameter"] == parameter, "value"].tolist()
            assert values == sorted(float(next(iter(each.values()))) for each in changes)
        learning = rows[rows["parameter"] == "calibrate-episodes"]
        assert sorted(zip(learning["value"], learning["method"], strict=True)) == sorted(
            (float(count), method) for count in COUNTS for method in LEARNING
        )
        assert rows.loc[rows["parameter"] == "phi", "value"].tolist() == list(PHIS)
        assert rows.loc[rows["parameter"] == "dropout-samples", "value"].tolist() == [float(k) for k in SAMPLES]
    assert (table["return_lo"] <= table["return_mean"] + 1e-9).all()
    assert (table["return_mean"] <= table["return_hi"] + 1e-9).all()


def test_more_draws_cost_more_episodes(table: pd.DataFrame) -> None:
    for parameter in ("candidates", "shared-episodes"):
        rows = table[(table["parameter"] == parameter) & (table["protocol"] == "onset")].sort_values("value")
        assert (np.diff(rows["tuning_episodes"]) > 0).all()


def test_a_decision_of_the_learner_alone_is_no_slower_than_one_with_every_signal(run: Run) -> None:
    times = load_frame(run.store.folder(run.varied[-1].key) / "latency.npz").set_index("method")
    assert (times["p50_ms"] > 0).all() and (times["p50_ms"] <= times["p95_ms"]).all()
    assert {"learner", "cem@total", "conformal@total", "cem-vector"} <= set(times.index)
    assert "oracle-hindsight" not in times.index  # looks at the table


def test_the_first_episodes_are_those_of_the_first_seeds_with_their_twins() -> None:
    calibration = random_calibration(3, "start")
    fewer = first_episodes(calibration, 2)
    assert fewer.nominal.seeds.tolist() == calibration.nominal.seeds[:2].tolist()
    assert sorted(fewer.panel.table.seeds.tolist()) == sorted([*fewer.nominal.seeds.tolist()] * 2)
    assert first_episodes(calibration, 100).panel.table.seeds.tolist() == calibration.panel.table.seeds.tolist()


def test_cem_takes_changed_settings_by_name() -> None:
    calibration = random_calibration(1, "onset")
    assert CEM("total", iterations=3).calibrate(calibration).log["accepted"].sum() == 3
    with pytest.raises(TypeError, match="iteration"):
        CEM("total", iteration=3).calibrate(calibration)


def test_a_costly_task_drives_rules_that_give_back_on_a_few_episodes(tmp_path: Path) -> None:
    task = replace(TASK, costly=True)
    run = Run(task, replace(MICRO, give_back_cells=2, test=GIVE_BACK_SEEDS + 1), Store(tmp_path), 1)
    rows = concat([load_frame(run.store.folder(job.key) / "episodes.npz") for job in run.episodes])
    count = rows[rows["protocol"] == "start"].groupby(["disturbance", "method"]).size()
    assert count["cart-mass", "cem-two@total"] == 2 * GIVE_BACK_SEEDS
    assert count["cart-mass", "cem@total"] == 2 * (GIVE_BACK_SEEDS + 1)
    assert "cem-two@total" not in count["none"]
    scored = leaderboard(rows, {task.name: run.task_info}).set_index(["disturbance", "protocol", "method"])
    assert scored.loc[("cart-mass", "start", "cem-two@total"), "episodes"] == 2 * GIVE_BACK_SEEDS
