"""How far ahead a signal sees: alarms, distances and kinds, on traces whose answer is known."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from safeswitch.handover.shown import JUDGED, Shown
from safeswitch.scoring.sightings import sighting_table, sightings, trailing_mean

E, T = 4, 60
DISTANCE = np.tile(np.linspace(9.0, -1.0, T), (E, 1))


def shown(signal: np.ndarray, visible: np.ndarray | None = None) -> Shown:
    seen = DISTANCE > -0.5 if visible is None else visible
    return Shown({"total": signal}, seen, DISTANCE, ("box", "box", "ball", "ball"))


def clean() -> dict[str, np.ndarray]:
    return {"total": np.random.default_rng(0).uniform(0.0, 1.0, (E, T))}


def test_the_trailing_mean_looks_back_alone() -> None:
    trace = np.arange(12.0).reshape(2, 6)
    np.testing.assert_allclose(trailing_mean(trace)[0], [0.0, 0.5, 1.0, 2.0, 3.0, 4.0])


def test_the_lead_is_the_distance_at_the_first_alarm() -> None:
    signal = np.where(DISTANCE < 4.0, 50.0, 0.0)
    table = sightings(shown(signal), clean(), ["total"]).set_index("kind")
    step = 9.0 - DISTANCE[0, 1]
    assert table.loc["box", "lead"] == pytest.approx(4.0, abs=step)
    assert (table["seen"] == 1.0).all() and (table["episodes"] == 2).all()
    assert table.loc["ball", "frame_auroc"] > 0.5


def test_a_signal_that_never_alarms_sees_nothing() -> None:
    table = sightings(shown(np.zeros((E, T))), clean(), ["total"])
    assert (table["seen"] == 0.0).all() and table["lead"].isna().all() and (table["frame_auroc"] < 0.01).all()


def test_alarms_before_it_is_in_view_or_behind_it_do_not_count() -> None:
    signal = np.where((DISTANCE > 6.0) | (DISTANCE < 0.0), 50.0, 0.0)
    visible = (DISTANCE < 5.0) & (DISTANCE > -0.5)
    assert (sightings(shown(signal, visible), clean(), ["total"])["seen"] == 0.0).all()


def test_frames_are_judged_within_the_distances() -> None:
    judged = shown(np.zeros((E, T))).judged
    assert judged.any() and DISTANCE[judged].min() >= JUDGED[0] and DISTANCE[judged].max() <= JUDGED[1]


def test_what_is_placed_nowhere_is_judged_whenever_it_shows() -> None:
    visible = np.zeros((E, T), bool)
    visible[:, 30:] = True
    nowhere = Shown({}, visible, np.full((E, T), np.nan), ("",) * E)
    assert np.array_equal(nowhere.judged, visible)


def test_the_table_has_the_median_over_learners() -> None:
    about = {"task": "t", "disturbance": "d", "severity": 3, "kind": "box", "signal": "total"}
    about |= {"episodes": 2, "seen": 1.0}
    rows = [{**about, "learner": i, "frame_auroc": auc, "lead": 2.0} for i, auc in enumerate((0.2, 0.9, 0.8))]
    table = sighting_table(pd.DataFrame(rows))
    assert len(table) == 1 and table["frame_auroc"].iloc[0] == 0.8 and table["learner_seeds"].iloc[0] == 3
