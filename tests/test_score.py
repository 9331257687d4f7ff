"""Scoring on published tables: the same numbers as the benchmark wrote, and clear refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from micro import MICRO
from safeswitch import cli, publish, suite
from safeswitch.handover.episode import NeverSwitch
from safeswitch.handover.panel import Calibration
from safeswitch.handover.published import PublishedTables, panel_of, write_table
from safeswitch.pipeline import Run
from safeswitch.score import find_tables, score_method, score_rule
from safeswitch.scoring.leaderboard import read_csv
from safeswitch.store import Store
from safeswitch_baselines.rules.base import ThresholdRule
from safeswitch_baselines.rules.cem import CEM
from synthetic import cliff_table

RESULTS = Path(__file__).resolve().parents[1] / "results"
TASK = suite.task("cart-pole")


def by_hand() -> ThresholdRule:
    """A ready rule, as an outsider's factory makes it."""
    return ThresholdRule("total", 0.1)


def never() -> NeverSwitch:
    return NeverSwitch()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two learners' tables of the cart-pole in which thresholds below an edge are right."""
    folder = tmp_path_factory.mktemp("published") / "cart-pole"
    for learner in (0, 1):
        for split in ("calibrate", "test"):
            for cell in TASK.cells[:2]:
                table = cliff_table(0.3, 12, cell.tag != "none", seed=learner)
                table = replace(table, seeds=np.array(suite.episode_seeds(split, 12)))  # type: ignore[arg-type]
                write_table(table, folder, cell, split, learner)  # type: ignore[arg-type]
    return folder


def test_a_rule_earns_the_mean_of_its_returns_on_the_tables(folder: Path) -> None:
    tables = PublishedTables.find(folder)
    scored = score_rule(tables, f"{__name__}:by_hand")
    assert scored.left_out == [] and len(scored.table) == 3
    for row in scored.table.to_dict("records"):
        returns = []
        for learner in tables.learners:
            panel = tables.panel(row["disturbance"], row["severity"], "test", learner, row["protocol"])
            returns.append(panel.returns(panel.handover_of(by_hand())))
        assert row["return_mean"] == pytest.approx(np.mean(returns))
        assert row["return_lo"] <= row["return_mean"] <= row["return_hi"]
        assert row["autonomy_lo"] <= row["autonomy"] <= row["autonomy_hi"]


def test_a_method_is_calibrated_on_the_calibrate_episodes(folder: Path) -> None:
    tables = PublishedTables.find(folder)
    table = score_method(tables, "cem@total").table
    row = table[(table["disturbance"] == "cart-mass") & (table["protocol"] == "start")].iloc[0]
    thresholds = []
    for learner in tables.learners:
        nominal = tables.load("none", 0, "calibrate", learner)
        panel = panel_of(tables.load("cart-mass", 3, "calibrate", learner), nominal, "start")
        thresholds.append(CEM("total").calibrate(Calibration(panel, nominal, seed=learner)).threshold)
    assert row["threshold"] == pytest.approx(np.median(thresholds))
    assert row["skill"] == row["skill"], "best@ and the references are there, so it has a skill"


@pytest.mark.skipif(not (RESULTS / "tables").is_dir(), reason="needs the committed results")
@pytest.mark.parametrize("task", sorted(path.name for path in (RESULTS / "tables").glob("*")))
@pytest.mark.parametrize(("rule", "method"), [("by_hand", "fixed-0.1@total"), ("never", "learner")])
def test_committed_tables_give_the_committed_leaderboard(task: str, rule: str, method: str) -> None:
    scored = score_rule(PublishedTables.find(RESULTS / "tables" / task), f"{__name__}:{rule}")
    board = read_csv(RESULTS / "leaderboard.csv")
    board = board[(board["task"] == task) & (board["method"] == method)]
    key = ["disturbance", "severity", "protocol"]
    both = scored.table.merge(board, on=key, suffixes=("", "_committed"))
    assert len(both) == len(scored.table) >= 4 and not scored.left_out
    for name in ("return_mean", "return_lo", "return_hi", "success", "success_lo", "success_hi", "autonomy"):
        np.testing.assert_allclose(both[name], both[f"{name}_committed"], rtol=1e-5, err_msg=name)


def test_unknown_outcomes_leave_a_cell_out_with_the_reason(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "cart-pole"
    copy.mkdir()
    for path in folder.glob("*.npz"):
        (copy / path.name).write_bytes(path.read_bytes())
    tables = PublishedTables.find(copy)
    table = tables.load("cart-mass", 3, "test", 1)
    table.sources[0].known[:] = -1
    table.save(copy / "cart-mass-3-test-learner1.npz", snapshots=False)
    scored = score_rule(tables, f"{__name__}:by_hand")
    assert set(scored.table["disturbance"]) == {"none"}
    assert len(scored.left_out) == 2 and all("--profile full" in reason for reason in scored.left_out)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rule", f"{__name__}:by_hand", "--method", "cem@total"], "not both"),
        ([], "--rule package.module:factory or --method id"),
        (["--rule", "no_such_package:rule"], "cannot be imported"),
        (["--rule", "safeswitch_baselines.rules.bounds:Timer"], "it is a method: use --method"),
        (["--method", "periodic"], "gives control back"),
        (["--method", "cem@totl"], "unknown signal 'totl'; valid, nearest first: total"),
        (["--method", "cemm@total"], "unknown method 'cemm'"),
    ],
)
def test_bad_input(folder: Path, capsys: Any, arguments: list[str], message: str) -> None:
    assert cli.main(["score", "--tables", str(folder), *arguments]) == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_tables_without_calibrate_episodes_say_what_to_do(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "cart-pole"
    copy.mkdir()
    for path in folder.glob("*-test-*.npz"):
        (copy / path.name).write_bytes(path.read_bytes())
    with pytest.raises(ValueError, match="no calibrate episodes of cart-pole/cart-mass-3.*--rule"):
        score_method(PublishedTables.find(copy), "cem@total")


def test_json_and_folders(folder: Path, tmp_path: Path, capsys: Any) -> None:
    assert cli.main(["score", "--tables", str(folder.parent), "--rule", f"{__name__}:by_hand", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert {row["task"] for row in printed["scores"]} == {"cart-pole"} and printed["left_out"] == []
    for bad in (tmp_path, tmp_path / "missing"):
        with pytest.raises(ValueError, match="tables"):
            find_tables(bad)


@pytest.mark.slow
def test_what_a_run_publishes_gives_its_own_leaderboard(tmp_path: Path) -> None:
    """Tables of both splits, complete, from which a calibrated method earns what the run says it earned."""
    run = Run(TASK, replace(MICRO, cells=3, tables=True), Store(tmp_path / "store"), 1)
    publish._write_tables(run, tmp_path / "cart-pole")
    tables = PublishedTables.find(tmp_path / "cart-pole")
    assert len(tables.files) == 5 and tables.cells == [("cart-mass", 3), ("none", 0), ("repaint", 3)]
    board = read_csv(run.store.folder(run.scores.key) / "leaderboard.csv")
    for method in ("cem@total", "fixed-q95@epistemic", "oracle-hindsight"):
        scored = score_method(tables, method)
        assert scored.left_out == [] and len(scored.table) == 5
        expected = board[board["method"] == method]
        both = scored.table.merge(expected, on=["disturbance", "severity", "protocol"], suffixes=("", "_run"))
        for name in ("return_mean", "return_lo", "return_hi", "success", "autonomy", "threshold"):
            np.testing.assert_allclose(both[name], both[f"{name}_run"], rtol=1e-5, err_msg=name)
