"""The leaderboard on random episodes: laws of skill and intervals, byte stability, merging, and what readers see."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safeswitch.scoring import (
    TaskInfo,
    csv_text,
    leaderboard,
    merge_task_rows,
    paired_comparisons,
    read_csv,
    write_csv,
    write_markdown,
)
from safeswitch.scoring.leaderboard import LEADING, format_number
from safeswitch.scoring.markdown import standing
from safeswitch.scoring.stats import mcnemar, wilson

T = 50
INFOS = {name: TaskInfo(horizon=T, control_dt=0.1) for name in ("cart-pole", "rally-car")}
METHODS = ("learner", "expert", "timer", "oracle-hindsight", "best@total", "cem@total", "fixed-q95@total", "random")
DELAY = {"learner": T, "expert": 0, "timer": 12, "oracle-hindsight": 7, "best@total": 8, "cem@total": 9, "random": 25}


@cache
def episodes(learners: int = 3, seeds: int = 12, task: str = "cart-pole", cells: tuple[str, ...] = ("cart-mass",)):
    """A world in which the learner fails most disturbed episodes and is lost 10 steps or so after the onset."""
    rng = np.random.default_rng(7)
    parts = []
    for cell in cells:
        onset = rng.integers(5, 25, seeds)
        doomed = rng.random((learners, seeds)) < 0.7
        last = np.minimum(onset + rng.integers(9, 16, (learners, seeds)), T - 1)
        for protocol in ("onset", "start"):
            for method in METHODS:
                for disturbed in (True,) if protocol == "onset" else (True, False):
                    parts.append(_rows(rng, method, protocol, disturbed, onset, doomed, last))
                    parts[-1].insert(0, "disturbance", cell)
    return pd.concat(parts, ignore_index=True).assign(task=task, severity=3, tuning_episodes=7, expert_queries=0)


def _rows(rng, method, protocol, disturbed, onset, doomed, last) -> pd.DataFrame:
    shape = doomed.shape
    start = np.broadcast_to(onset, shape) if disturbed else np.full(shape, T)
    arming = start if protocol == "onset" else np.zeros(shape, int)
    delay = DELAY.get(method, 9) + (rng.integers(0, 2 if method == "best@total" else 3, shape) if "@" in method else 0)
    base = arming if method in ("expert", "timer") else start
    handover = np.minimum(base + delay, T)
    alone = ~doomed if disturbed else np.ones(shape, bool)
    learner, seed = np.meshgrid(np.arange(shape[0]), 100 + np.arange(shape[1]), indexing="ij")
    columns = {
        "protocol": protocol, "method": method, "learner": learner, "seed": seed, "disturbed": disturbed,
        "onset": start if disturbed else np.full(shape, -1), "arming_step": arming, "handover": handover,
        "learner_steps": handover, "armed_learner_steps": handover - arming,
        "success": alone | (handover <= last), "learner_success": alone,
        "t_first": np.where(alone, T, last) if disturbed else np.nan,
        "t_last": np.where(alone, T, last) if disturbed else np.nan,
        "handovers": handover < T, "threshold": 0.1 + learner if "@" in method else np.nan,
    }  # fmt: skip
    return pd.DataFrame({name: np.broadcast_to(value, shape).ravel() for name, value in columns.items()})


def row(table: pd.DataFrame, method: str, protocol: str = "start") -> pd.Series:
    chosen = table[(table["method"] == method) & (table["protocol"] == protocol)]
    assert len(chosen) == 1
    return chosen.iloc[0]


def test_columns_of_the_contract_come_first() -> None:
    assert LEADING == (
        "task,disturbance,severity,protocol,method,learner_seeds,episodes,return_mean,return_lo,return_hi,skill,"
        "skill_lo,skill_hi,success,success_lo,success_hi,autonomy,recovery,harm,timely,margin_s,delay_s,false_alarms,"
        "handovers,threshold,tuning_episodes"
    ).split(",")
    table = leaderboard(episodes(), INFOS, resamples=50)
    assert list(table)[: len(LEADING)] == LEADING
    assert len(table) == 2 * len(METHODS)
    assert row(table, "cem@total")["episodes"] == 2 * row(table, "cem@total", "onset")["episodes"] == 72


def test_skill_is_one_for_the_hindsight_best_and_zero_for_the_best_reference() -> None:
    table = leaderboard(episodes(), INFOS, resamples=200)
    for protocol in ("onset", "start"):
        best = row(table, "best@total", protocol)
        assert (best["skill"], best["skill_lo"], best["skill_hi"]) == (1, 1, 1)
        references = [row(table, name, protocol)["return_mean"] for name in ("learner", "expert", "timer")]
        cem = row(table, "cem@total", protocol)
        assert cem["contest_gap"] == pytest.approx(best["return_mean"] - max(references))
        assert cem["skill"] == pytest.approx((cem["return_mean"] - max(references)) / cem["contest_gap"])
        assert cem["skill_lo"] <= cem["skill"] <= cem["skill_hi"]
        assert 0 < cem["contest_share"] <= 1
        assert np.isnan(row(table, "random", protocol)["skill"])
        assert np.isnan(row(table, "random", protocol)["contest_gap"])


def test_no_contest_below_a_tenth_and_no_skill_without_references() -> None:
    frame = episodes()
    level = frame[frame["method"] == "timer"].assign(method="best@total")
    table = leaderboard(pd.concat([frame[frame["method"] != "best@total"], level]), INFOS, resamples=50)
    cem = row(table, "cem@total", "onset")
    assert np.isnan(cem["skill"]) and cem["contest_gap"] < 0.1
    without = leaderboard(frame[frame["method"] != "timer"], INFOS, resamples=50)
    assert without["skill"].isna().all() and without["contest_gap"].isna().all()


def test_return_does_not_depend_on_other_methods_or_tasks() -> None:
    frame = episodes()
    few = frame[frame["method"].isin(["cem@total", "expert"])]
    both = pd.concat([frame, episodes(task="rally-car")])
    columns = ["return_mean", "return_lo", "return_hi", "success_lo", "success_hi"]
    expected = row(leaderboard(frame, INFOS), "cem@total")[columns]
    assert row(leaderboard(few, INFOS), "cem@total")[columns].equals(expected)
    merged = leaderboard(both, INFOS)
    assert row(merged[merged["task"] == "cart-pole"], "cem@total")[columns].equals(expected)


def test_methods_on_fewer_episodes_are_measured_on_those() -> None:
    frame = episodes()
    fewer = frame[(frame["method"] == "cem@total") & (frame["seed"] < 106)].assign(method="vote@total")
    table = leaderboard(pd.concat([frame, fewer]), INFOS, resamples=100)
    alone = leaderboard(pd.concat([frame, fewer])[lambda f: f["seed"] < 106], INFOS, resamples=100)
    names = ["episodes", "return_mean", "return_lo", "skill", "skill_lo", "contest_gap"]
    assert row(table, "vote@total")[names].equals(row(alone, "vote@total")[names])
    assert row(table, "cem@total")[names].equals(row(leaderboard(frame, INFOS, resamples=100), "cem@total")[names])


def test_success_interval_is_wilson_within_one_learner_and_bootstrap_over_several() -> None:
    one = row(leaderboard(episodes(learners=1), INFOS), "cem@total")
    assert one["success_interval"] == "wilson"
    assert (one["success_lo"], one["success_hi"]) == wilson(round(one["success"] * one["episodes"]), one["episodes"])
    several = leaderboard(episodes(), INFOS)
    assert row(several, "cem@total")["success_interval"] == "bootstrap"
    sure = row(several, "expert")
    assert sure["success"] == 1 and sure["success_interval"] == "wilson-seeds"
    assert (sure["success_lo"], sure["success_hi"]) == wilson(12, 12)


def test_same_bytes_whatever_the_order_of_the_episodes(tmp_path: Path) -> None:
    frame = episodes(cells=("cart-mass", "push"))
    text = csv_text(leaderboard(frame, INFOS, resamples=100))
    for seed in range(3):
        shuffled = frame.sample(frac=1, random_state=seed)
        assert csv_text(leaderboard(shuffled, INFOS, resamples=100)) == text
    path = write_csv(leaderboard(frame, INFOS, resamples=100).iloc[::-1], tmp_path / "new" / "leaderboard.csv")
    assert path.read_text() == text
    assert csv_text(read_csv(path)) == text
    assert [p.name for p in path.parent.iterdir()] == ["leaderboard.csv"]


def test_rows_calibrated_elsewhere_stay_apart() -> None:
    frame = episodes().assign(calibrated_on="cart-mass-3")
    other = frame[frame["method"].isin(["cem@total"])].assign(calibrated_on="push-3")
    table = leaderboard(pd.concat([frame, other]), INFOS, resamples=50)
    cem = table[(table["method"] == "cem@total") & (table["protocol"] == "start")]
    assert cem["calibrated_on"].tolist() == ["cart-mass-3", "push-3"]
    assert cem["skill"].nunique() == 1  # the same episodes, the same references


def test_merging_replaces_the_rows_of_one_task_only(tmp_path: Path) -> None:
    pole, car = (leaderboard(episodes(task=task), INFOS, resamples=50) for task in ("cart-pole", "rally-car"))
    path = write_csv(merge_task_rows(tmp_path / "absent.csv", car), tmp_path / "leaderboard.csv")
    assert csv_text(car) == path.read_text()
    write_csv(merge_task_rows(path, pole), path)
    lines = path.read_text().splitlines()
    assert lines[0] == csv_text(pole).splitlines()[0]
    assert lines[1:] == csv_text(pole).splitlines()[1:] + csv_text(car).splitlines()[1:]
    fewer = pole[pole["method"] != "random"]
    write_csv(merge_task_rows(path, fewer), path)
    assert path.read_text().splitlines()[1:] == csv_text(fewer).splitlines()[1:] + csv_text(car).splitlines()[1:]


@given(st.floats(allow_nan=False))
def test_written_numbers_are_stable_and_accurate(value: float) -> None:
    text = format_number(value)
    assert format_number(float(text)) == text
    assert float(text) == pytest.approx(value, rel=1e-5)


def test_numbers_as_they_are_written() -> None:
    shown = [format_number(value) for value in (0.1, -0.0, 3.0, 1234567, np.nan, np.inf, 1 / 3, 99999.96)]
    assert shown == ["0.1", "0", "3", "1234567", "", "inf", "0.333333", "100000"]


def test_comparisons_are_paired_and_name_the_winner() -> None:
    frame = episodes(learners=1, seeds=40)
    table = paired_comparisons(frame, INFOS, "cem@total", resamples=300)
    assert len(table) == 2 * (len(METHODS) - 1)
    scores = leaderboard(frame, INFOS, resamples=50)
    learner = row(table, "learner", "onset")
    gap = row(scores, "cem@total", "onset")["return_mean"] - row(scores, "learner", "onset")["return_mean"]
    assert learner["return_diff"] == pytest.approx(gap)
    assert learner["return_diff_lo"] < gap < learner["return_diff_hi"]
    assert learner["winner"] == "cem@total"
    part = frame[frame["protocol"] == "onset"].sort_values("seed").set_index("method")["success"]
    test = mcnemar(part["cem@total"], part["learner"])
    assert (learner["only_reference"], learner["only_method"]) == (test.only_a, test.only_b)
    assert learner["mcnemar_p"] == test.p < learner["mcnemar_holm"] < 0.05
    assert learner["learners_better"] == 1 and learner["learners_worse"] == 0
    reverse = row(paired_comparisons(frame, INFOS, "learner", resamples=300), "cem@total", "onset")
    assert reverse["winner"] == "cem@total"
    assert reverse["return_diff_hi"] == pytest.approx(-learner["return_diff_lo"])


def test_comparisons_over_several_learners_have_no_single_p_value() -> None:
    table = paired_comparisons(episodes(seeds=40), INFOS, "cem@total", resamples=100)
    assert table[["mcnemar_p", "mcnemar_holm"]].isna().all(axis=None)
    assert row(table, "learner", "onset")["learners_better"] == 3
    with pytest.raises(ValueError, match="unknown reference method 'cem@totl'; valid, nearest first: cem@total"):
        paired_comparisons(episodes(), INFOS, "cem@totl")


def test_a_method_like_the_reference_is_a_tie() -> None:
    frame = episodes()
    twin = frame[frame["method"] == "cem@total"].assign(method="copy@total")
    copy = row(paired_comparisons(pd.concat([frame, twin]), INFOS), "copy@total")
    assert (copy["return_diff"], copy["return_diff_lo"], copy["return_diff_hi"], copy["winner"]) == (0, 0, 0, "tie")


def test_standing_sets_bounds_and_controls_apart() -> None:
    kinds = {name: standing(name, privileged=["simplex"], give_back=["hysteresis@total"]) for name in METHODS}
    assert kinds["best@total"] == kinds["oracle-hindsight"] == standing("simplex", ["simplex"]) == "bound"
    assert kinds["random"] == standing("shuffled@total") == "control"
    assert standing("random-search@total") == kinds["cem@total"] == "rule"
    assert kinds["timer"] == "reference"
    assert standing("hysteresis@total", (), ["hysteresis@total"]) == "give-back"


def test_markdown_has_the_headline_the_tables_and_the_words(tmp_path: Path) -> None:
    frame = episodes(cells=("cart-mass", "push"))
    level = frame[(frame["method"] == "timer") & (frame["disturbance"] == "push")].assign(method="best@total")
    frame = pd.concat([frame[(frame["method"] != "best@total") | (frame["disturbance"] != "push")], level])
    path = tmp_path / "leaderboard.md"
    write_markdown(leaderboard(frame, INFOS, resamples=50), path, notes=["profile `test`"], give_back=["random"])
    text = path.read_text()
    assert text.startswith("# SafeSwitch leaderboard\n\nprofile `test`")
    assert "### Headline: the paper's cell, cart-mass severity 3" in text
    assert "no contest" in text
    assert text.count("<details>") == text.count("</details>") == 1  # `push`, the paper's cell is open
    assert "*`best@total`* †" in text
    columns = "method,needs,return,skill,success,autonomy,recovery,harm,timely,false alarms,tuning episodes"
    header = f"| {columns.replace(',', ' | ')} |"
    assert header in text
    for line in text.splitlines():
        if line.startswith("|"):
            assert line.count("|") in (header.count("|"), 10)
    again = tmp_path / "again.md"
    shuffled = leaderboard(frame.sample(frac=1, random_state=1), INFOS, resamples=50)
    write_markdown(shuffled, again, notes=["profile `test`"], give_back=["random"])
    assert again.read_text() == text


def test_paper_cells_can_be_chosen(tmp_path: Path) -> None:
    table = leaderboard(episodes(cells=("cart-mass", "push")), INFOS, resamples=50)
    write_markdown(table, tmp_path / "a.md", paper_cells={"cart-pole": ("push", 3)})
    assert "### Headline: the paper's cell, push severity 3" in (tmp_path / "a.md").read_text()
    write_markdown(table, tmp_path / "b.md", paper_cells={"cart-pole": ("absent", 3)})
    assert "Not part of this run." in (tmp_path / "b.md").read_text()
