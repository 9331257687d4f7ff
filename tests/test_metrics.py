"""Every score on hand-made episodes, and signal quality against brute force."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safeswitch.handover import panel
from safeswitch.scoring import TaskInfo, auroc, fpr_at_tpr, signal_quality, signal_table
from safeswitch.scoring.metrics import PHI, episode_scores, prepare, returns, signal_of, summary
from safeswitch.scoring.signal_quality import frame_quality

T, DT = 100, 0.06
INFOS = {"cart-pole": TaskInfo(horizon=T, control_dt=DT)}
NAN = float("nan")


def episode(method: str, handover: int, success: bool, **changes: Any) -> dict[str, Any]:
    """Disturbed at step 40, failed by the learner alone and armed at the onset, unless `changes` say otherwise."""
    row: dict[str, Any] = {
        "task": "cart-pole", "disturbance": "cart-mass", "severity": 3, "protocol": "onset", "method": method,
        "learner": 0, "seed": 0, "disturbed": True, "onset": 40, "handover": handover, "success": success,
        "learner_success": False, "t_first": 60.0, "t_last": 65.0, "threshold": NAN, "tuning_episodes": 0,
        "expert_queries": 0,
    }  # fmt: skip
    row |= changes
    if not row["disturbed"]:
        row |= {"onset": -1, "t_first": NAN, "t_last": NAN}
    row.setdefault("arming_step", row["onset"] if row["protocol"] == "onset" else 0)
    row.setdefault("learner_steps", handover)
    row.setdefault("armed_learner_steps", max(row["learner_steps"] - row["arming_step"], 0))
    row.setdefault("handovers", int(handover < T))
    return row


def undisturbed(method: str, handover: int, success: bool, **changes: Any) -> dict[str, Any]:
    options: dict[str, Any] = {"disturbed": False, "protocol": "start", "learner_success": True, **changes}
    return episode(method, handover, success, **options)


def scores(**row: Any) -> pd.Series:
    frame = prepare(pd.DataFrame([row]), INFOS)
    return episode_scores(frame, INFOS).iloc[0]


def test_phi_is_the_one_of_the_handover_table() -> None:
    assert PHI == panel.PHI


def test_return_counts_armed_learner_steps_and_success() -> None:
    rows = [episode("a", 55, True, seed=0), episode("a", T, False, seed=1, learner_steps=80)]
    frame = prepare(pd.DataFrame(rows), INFOS)
    assert returns(frame, INFOS).tolist() == pytest.approx([0.15 + 5, 0.40])
    assert returns(frame, INFOS, 20).tolist() == pytest.approx([20.15, 0.40])
    assert episode_scores(frame, INFOS)["autonomy"].tolist() == pytest.approx([0.55, 0.80])


def test_a_timely_handover() -> None:
    score = scores(**episode("a", 50, True))
    assert score["recovery"] == score["timely"] == 1
    assert score["margin_s"] == pytest.approx(10 * DT)
    assert score["delay_s"] == pytest.approx(10 * DT)
    assert score["share_used"] == pytest.approx(0.5)
    assert score["missed"] == 0
    assert score[["harm", "harm_disturbed", "harm_undisturbed", "false_alarms"]].isna().all()


def test_a_late_handover_has_a_negative_margin_and_is_not_missed() -> None:
    score = scores(**episode("a", 63, False))
    assert score["margin_s"] == pytest.approx(-3 * DT)
    assert (score["missed"], score["timely"], score["recovery"], score["share_used"]) == (0, 0, 0, 1)


def test_a_missed_handover_is_counted_and_has_no_margin() -> None:
    score = scores(**episode("a", T, False, learner_steps=70))
    assert (score["missed"], score["timely"], score["share_used"]) == (1, 0, 1)
    assert np.isnan(score["margin_s"]) and np.isnan(score["delay_s"])


def test_a_handover_before_the_onset_is_not_timely() -> None:
    score = scores(**episode("a", 30, True, protocol="start", disturbance="none"))
    assert (score["recovery"], score["timely"], score["false_alarms_before_onset"], score["share_used"]) == (1, 0, 1, 0)
    assert np.isnan(score["delay_s"])


def test_a_handover_at_the_onset_is_timely() -> None:
    score = scores(**episode("a", 40, True))
    assert (score["timely"], score["delay_s"], score["share_used"]) == (1, 0, 0)


def test_what_cannot_be_recovered_is_in_recovery_but_neither_timely_nor_missed() -> None:
    score = scores(**episode("a", 45, False, t_first=NAN, t_last=NAN))
    assert score["recovery"] == 0
    assert score[["timely", "margin_s", "missed", "share_used"]].isna().all()
    gap = scores(**episode("a", 45, True, t_first=NAN, t_last=65.0))  # o(s) need not be monotone
    assert gap["timely"] == 1 and np.isnan(gap["margin_s"])


def test_harm_is_failing_where_the_learner_alone_succeeds() -> None:
    hurt = scores(**episode("a", 50, False, learner_success=True, t_first=100.0, t_last=100.0))
    assert (hurt["harm"], hurt["harm_disturbed"]) == (1, 1)
    assert hurt[["harm_undisturbed", "recovery", "timely", "margin_s"]].isna().all()
    calm = scores(**undisturbed("a", T, True, disturbance="none"))
    assert (calm["harm"], calm["harm_undisturbed"], calm["false_alarms"]) == (0, 0, 0)
    assert np.isnan(calm["harm_disturbed"])


def test_false_alarms_count_handovers_of_undisturbed_episodes() -> None:
    assert scores(**undisturbed("a", 20, True, handovers=3, disturbance="none"))["false_alarms"] == 3


def test_summary_takes_medians_means_and_the_spread_over_learners() -> None:
    rows = [
        episode("a", h, True, seed=i, learner=i % 2, threshold=0.1 * (1 + i % 2)) for i, h in enumerate((41, 42, 50))
    ]
    table = summary(prepare(pd.DataFrame(rows), INFOS), INFOS).iloc[0]
    assert table["delay_s"] == pytest.approx(2 * DT)
    assert table["autonomy"] == pytest.approx(np.mean([0.41, 0.42, 0.50]))
    assert table["threshold"] == pytest.approx(0.15)
    assert (table["return_learner_min"], table["return_learner_max"]) == pytest.approx((5.02, 5.055))
    assert table["needing_handover"] == 3
    assert np.isnan(table["return_prevalence10"])


def test_prevalence_reweights_the_two_halves() -> None:
    rows = [episode("a", 50, False, protocol="start"), undisturbed("a", T, True)]
    table = summary(prepare(pd.DataFrame(rows), INFOS), INFOS).iloc[0]
    assert table["return_prevalence10"] == pytest.approx(0.1 * 0.5 + 0.9 * 6)
    assert table["return_prevalence90"] == pytest.approx(0.9 * 0.5 + 0.1 * 6)


def test_signal_of() -> None:
    assert signal_of("cem@total-mean3") == "total-mean3"
    assert signal_of("timer") is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task": "cartpole"}, "unknown task 'cartpole'.*cart-pole"),
        ({"protocol": "onsets"}, "unknown protocol 'onsets'; valid, nearest first: onset"),
        ({"handover": 101}, "0 <= handover <= T"),
        ({"success": 0.5}, "'success' must hold true or false"),
        ({"seed": 1.5}, "'seed' must hold whole numbers"),
        ({"onset": -1}, "onset >= 0 where disturbed"),
        ({"armed_learner_steps": 60}, "armed_learner_steps <= learner_steps"),
        ({"protocol": "start"}, "twin"),
        ({"disturbed": False, "onset": -1}, "disturbed episodes only"),
    ],
)
def test_wrong_episodes_are_refused_by_name(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        prepare(pd.DataFrame([{**episode("a", 50, True), **change}]), INFOS)


def test_missing_columns_and_repeated_episodes_are_refused() -> None:
    rows = pd.DataFrame([episode("a", 50, True)])
    with pytest.raises(ValueError, match=r"lack the columns \['t_last'\]"):
        prepare(rows.drop(columns="t_last"), INFOS)
    with pytest.raises(ValueError, match="occur twice"):
        prepare(pd.concat([rows, rows]), INFOS)
    with pytest.raises(ValueError, match="no episodes"):
        prepare(rows.iloc[:0], INFOS)
    with pytest.raises(ValueError, match="control_dt"):
        TaskInfo(100, 0.0)


VALUES = st.lists(st.integers(0, 5).map(float), min_size=1, max_size=12)


@given(VALUES, VALUES)
def test_auroc_equals_brute_force_with_ties(up: list[float], down: list[float]) -> None:
    pairs = [1.0 if p > n else 0.5 if p == n else 0.0 for p in up for n in down]
    assert auroc(up, down) == pytest.approx(np.mean(pairs))
    assert auroc(down, up) == pytest.approx(1 - np.mean(pairs))


@given(VALUES, VALUES)
def test_fpr_equals_brute_force(up: list[float], down: list[float]) -> None:
    threshold = max(t for t in up if np.mean(np.array(up) >= t) >= 0.95)
    assert fpr_at_tpr(up, down) == np.mean(np.array(down) >= threshold)


def test_fpr_on_hand_examples() -> None:
    up = np.arange(1, 21, dtype=float)  # 19 of 20 reach 2
    assert fpr_at_tpr(up, [0, 1, 2, 3]) == 0.5
    assert fpr_at_tpr(up, [0, 1]) == 0
    assert fpr_at_tpr([3, 3], [3, 2]) == 0.5  # a tie with the threshold alarms
    assert fpr_at_tpr(np.arange(100), np.arange(100)) == 0.95
    with pytest.raises(ValueError, match="tpr"):
        fpr_at_tpr(up, up, 0.0)


def test_nothing_to_compare_is_nan_and_nan_scores_are_refused() -> None:
    assert np.isnan(auroc([], [1.0])) and np.isnan(fpr_at_tpr([1.0], []))
    with pytest.raises(ValueError, match="1 of 2 positive scores are NaN"):
        auroc([1.0, NAN], [1.0])


def test_signal_quality_uses_the_right_frames_and_windows() -> None:
    disturbed = np.array([[9.0, 1, 5, 6, NAN], [9, 1, 1, 1, 1]])
    twin = np.array([[9.0, 1, 2, 7, 8], [9, 1, 1, 1, 3]])
    onset, t_first, alone = np.array([1, 2]), np.array([2.0, 100]), np.array([False, True])
    quality = signal_quality(disturbed, twin, onset, t_first, alone)
    positive, negative = [1, 5, 6, 1, 1, 1], [1, 2, 7, 1, 1, 3]  # from t0 on, until either has ended
    assert quality.frame_auroc == pytest.approx(auroc(positive, negative))
    assert quality.fpr95 == fpr_at_tpr(positive, negative)
    assert quality.episode_auroc == 1.0  # only episode 0 counts: 5 against 2 on [1, 2]
    visible = np.zeros((2, 5), bool)
    visible[0, 2] = True
    shown = frame_quality(disturbed, twin, visible)
    assert shown.frame_auroc == 1.0 and shown.fpr95 == 0.0 and np.isnan(shown.episode_auroc)
    visible[1] = True
    expected = auroc([5.0, *disturbed[1]], [2.0, *twin[1]])
    assert frame_quality(disturbed, twin, visible).frame_auroc == expected
    visible[0, 4] = True  # ended: left out on both sides
    assert frame_quality(disturbed, twin, visible).frame_auroc == expected
    with pytest.raises(ValueError, match="onset"):
        signal_quality(disturbed, twin, np.array([-1, 2]), t_first, alone)
    with pytest.raises(ValueError, match="one shape"):
        signal_quality(disturbed, twin[:1], onset, t_first, alone)


def test_signal_table_is_the_median_over_learners() -> None:
    rows = [
        {"task": "cart-pole", "disturbance": "push", "severity": 3, "signal": "total", "learner": i, "frame_auroc": a,
         "episode_auroc": NAN, "fpr95": 0.1}
        for i, a in enumerate((0.9, 0.7, 0.8))
    ]  # fmt: skip
    table = signal_table(pd.DataFrame(rows).iloc[::-1])
    assert list(table)[:8] == [
        "task", "disturbance", "severity", "signal", "frame_auroc", "episode_auroc", "fpr95", "learner_seeds",
    ]  # fmt: skip
    row = table.iloc[0]
    assert (row["frame_auroc"], row["frame_auroc_min"], row["frame_auroc_max"]) == (0.8, 0.7, 0.9)
    assert row["learner_seeds"] == 3 and np.isnan(row["episode_auroc"])
    with pytest.raises(ValueError, match="several rows"):
        signal_table(pd.DataFrame([rows[0], rows[0]]))
