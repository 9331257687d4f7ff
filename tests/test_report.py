"""The report's data: what the page computes at a marked threshold is what the leaderboard says, to its last digit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

import report_reader as reader
from results_folder import TASK, write_results
from safeswitch import cli
from safeswitch.handover.panel import Panel
from safeswitch.report import NAME, write_report
from safeswitch.report.marks import agrees
from safeswitch.report.pack import GAP, Order, Pack, from_text, levels, records, to_text
from safeswitch.report.views import name_of, tables_in
from safeswitch.scoring import read_csv
from safeswitch.scoring.thresholds import FILE, read_thresholds
from synthetic import random_table

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_results(tmp_path_factory.mktemp("results"))
    write_report(folder)
    return folder


def check_marks(folder: Path) -> dict[str, set[str]]:
    """Every mark of every task gives its row of the leaderboard; returns task -> marked methods."""
    board, marked = read_csv(folder / "leaderboard.csv"), {}
    for task, bundle in reader.tasks_of(folder / NAME).items():
        rows = board[board["task"] == task].assign(calibrated_on=lambda frame: _on(frame))
        rows["cell"] = rows["disturbance"] + "-" + rows["severity"].astype(str)
        rows = rows.set_index(["cell", "protocol", "method", "calibrated_on"])
        for signal in bundle["exact"]["signals"]:
            for view, marks in signal["marks"].items():
                cell, protocol = view.split("/")
                for method, on, _, compared in marks:
                    thresholds = [reader.real(value) for value in compared]
                    found = reader.handovers(bundle, cell, protocol, signal["name"], thresholds)
                    row = rows.loc[cell, protocol, method, on]
                    for name, value in reader.scores(found, bundle["exact"]["horizon"], protocol).items():
                        assert reader.same(float(row[name]), value), (task, view, method, name, row[name], value)
                    marked.setdefault(task, set()).add(f"{view} {method}")
    return marked


def _on(frame: pd.DataFrame) -> pd.Series:
    return (
        frame["calibrated_on"].astype(object).fillna("")
        if "calibrated_on" in frame
        else pd.Series("", index=frame.index)
    )


def test_numbers_at_every_mark_are_those_of_the_leaderboard(results: Path) -> None:
    marked = check_marks(results)["cart-pole"]
    for view in ("cart-mass-3/onset", "cart-mass-3/start", "none-0/start", "repaint-3/start"):
        for rule in ("best", "cem", "fixed-q95", "fixed-q99", "grid"):
            assert f"{view} {rule}@total" in marked and f"{view} {rule}@epistemic" in marked


def test_any_threshold_hands_over_where_the_panel_does(results: Path) -> None:
    bundle = reader.tasks_of(results / NAME)["cart-pole"]
    tables = {
        (name_of(view.cell), view.protocol): view for view in tables_in(results / "tables" / TASK.name, TASK).views()
    }
    rng = np.random.default_rng(5)
    for cell, protocol, signal in reader.views(bundle):
        panels = tables[cell, protocol].panels.values()
        for threshold in (-np.inf, *rng.uniform(-0.5, 5.5, 4), np.inf):
            found = reader.handovers(bundle, cell, protocol, signal, [threshold] * len(panels))
            steps = [panel.handover_at(signal, np.array([threshold]))[0] for panel in panels]
            success = [panel.success(step) for panel, step in zip(panels, steps, strict=True)]
            assert np.array_equal(found[:, 0], np.concatenate(steps))
            assert np.array_equal(found[:, 1], np.concatenate(success))


def test_margins_are_those_of_the_panels(results: Path) -> None:
    bundle = reader.tasks_of(results / NAME)["cart-pole"]
    signals = {signal["name"]: signal for signal in bundle["exact"]["signals"]}
    some = 0
    for view in tables_in(results / "tables" / TASK.name, TASK).views():
        for name, signal in signals.items():
            limits = signal["margins"][f"{name_of(view.cell)}/{view.protocol}"]
            for panel, written in zip([view.pooled, *view.panels.values()], limits, strict=True):
                low, high = panel.margins(name)
                assert (written is None) == np.isnan(low)
                if written:
                    assert np.allclose([reader.real(value) for value in written], [low, high], rtol=1e-6)
                    some += 1
    assert some


def test_a_rule_that_is_no_threshold_on_its_own_trace_is_not_marked(results: Path) -> None:
    thresholds = read_thresholds(results / "tables" / TASK.name / FILE)
    methods = set(thresholds["method"])
    assert {"cem@total", "grid@epistemic"} <= methods
    assert not methods & {"learner", "expert", "timer", "random", "oracle-hindsight"}
    shuffled = thresholds[thresholds["method"] == "shuffled@total"].groupby(["disturbance", "protocol"]).size()
    assert (shuffled < 2).all()  # not for both learners: that would be chance


def test_thresholds_of_another_run_are_refused(tmp_path: Path) -> None:
    folder = write_results(tmp_path, learners=1, cells=2)
    path = folder / "tables" / TASK.name / FILE
    frame = pd.read_csv(path)
    wrong = frame["method"] == "cem@total"
    frame.loc[wrong, "threshold"] = -1.0
    frame.to_csv(path, index=False)
    with pytest.raises(ValueError, match="cem@total.*of different runs"):
        write_report(folder)


def test_without_published_thresholds_marks_are_recovered_or_left_out_but_never_wrong(tmp_path: Path) -> None:
    folder = write_results(tmp_path, learners=1, cells=2)
    (folder / "tables" / TASK.name / FILE).unlink()
    write_report(folder)
    assert "cart-mass-3/onset best@total" in check_marks(folder)["cart-pole"]


def test_without_tables_there_is_a_page_with_the_leaderboard(tmp_path: Path) -> None:
    folder = write_results(tmp_path / "whole", learners=1, cells=2)
    (tmp_path / "leaderboard.csv").write_bytes((folder / "leaderboard.csv").read_bytes())
    bundle = reader.tasks_of(write_report(tmp_path))["cart-pole"]
    assert "exact" not in bundle
    rows = bundle["cells"][0]["boards"]["onset"]["rows"]
    assert {row[0] for row in rows} >= {"learner", "expert", "cem@total"}


def test_the_same_results_give_the_same_bytes(results: Path, tmp_path: Path) -> None:
    before = (results / NAME).read_bytes()
    assert write_report(results).read_bytes() == before
    assert b"http://" not in before.replace(b"http://www.w3.org/2000/svg", b"") and b"https://" not in before


def test_a_folder_without_results_is_an_error_that_says_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert cli.main(["report", "--results", str(tmp_path)]) == 2
    assert "leaderboard.csv" in capsys.readouterr().err


@given(st.lists(st.floats(allow_nan=False, width=64), min_size=1, max_size=30), st.integers(0, 3))
def test_the_order_keeps_every_comparison(values: list[float], crowd: int) -> None:
    near = [float(np.nextafter(value, np.inf)) for value in values for _ in range(crowd > 0)]
    exact = np.array([*values, *near])
    if not np.isfinite(exact).any() or np.abs(exact[np.isfinite(exact)]).max() > 1e38:
        return
    mapped = Order(exact)(exact)
    assert np.array_equal(mapped[:, None] > mapped[None, :], exact[:, None] > exact[None, :])


def test_the_order_refuses_a_value_that_it_does_not_know() -> None:
    with pytest.raises(ValueError, match="not made from"):
        Order(np.array([1.0, 2.0]))([1.5])


def test_records_are_where_the_running_maximum_rises() -> None:
    running = Panel(random_table(3, 8), "onset").running_max("total")
    counts, steps, values = records(running)
    rebuilt, place = np.full_like(running, -np.inf), 0
    for episode, count in enumerate(counts):
        for index in range(place, place + count):
            rebuilt[episode, steps[index] :] = values[index]
        place += count
    assert np.array_equal(rebuilt, running)


def test_levels_are_within_half_a_level_and_gaps_stay() -> None:
    trace = np.array([[0.1, 0.5, np.nan, 10.0]])
    drawn = levels(trace, 0.1, 10.0, True)
    assert drawn[0, 2] == GAP
    back = 0.1 * (10.0 / 0.1) ** (drawn[0, [0, 1, 3]] / (GAP - 1))
    assert np.all(np.abs(np.log(back / trace[0, [0, 1, 3]])) <= 0.5 * np.log(100) / (GAP - 1) + 1e-12)


def test_a_pack_refuses_what_its_type_does_not_hold_and_aligns_the_rest() -> None:
    pack = Pack()
    pack.add("a", [1, 2, 3], "uint8")
    pack.add("b", [1.5], "float32")
    assert pack.directory["b"] == ["float32", 4, 1]
    assert from_text(to_text(pack.data())) == pack.data()
    with pytest.raises(ValueError, match="uint8 does not hold"):
        pack.add("c", [256], "uint8")


@given(st.floats(1e-6, 1e6))
def test_a_number_agrees_with_its_six_digits_and_with_no_others(value: float) -> None:
    written = float(f"{value:.6g}")
    assert agrees(written, value)
    assert not agrees(written * (1 + 3e-5), value)


@pytest.mark.slow
@pytest.mark.skipif(not (ROOT / "results" / "tables").is_dir(), reason="needs the committed results")
def test_the_committed_results_give_the_leaderboards_numbers_at_every_mark(tmp_path: Path) -> None:
    for name in ("leaderboard.csv", "cem_seeds.csv", "manifest.json", "tables", "figures"):
        (tmp_path / name).symlink_to(ROOT / "results" / name)
    page = write_report(tmp_path)
    marked = check_marks(tmp_path)
    for task, methods in marked.items():
        for cell, protocol in reader.tasks_of(page)[task]["exact"]["views"]:
            assert f"{cell}/{protocol} cem@total" in methods, (task, cell, protocol)
    assert page.stat().st_size <= 5e6
