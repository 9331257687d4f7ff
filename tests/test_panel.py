"""The handover table seen through an arming, on random tables: shortcuts agree with asking a rule step by step."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safeswitch.handover.outcomes import SOLVER_FAILURE, UNKNOWN
from safeswitch.handover.panel import Calibration, Panel
from safeswitch.handover.table import HandoverTable, concatenate, new_table
from safeswitch.scoring.failures import failure_table
from safeswitch.suite import Cell
from safeswitch_baselines.rules.base import DelayRule, ThresholdRule
from safeswitch_baselines.rules.bounds import OracleHindsight
from synthetic import HORIZON, random_table


class WithoutShortcut:
    """A rule as an outsider would write it: reset, arm and update only."""

    def __init__(self, rule):
        self.reset, self.arm, self.update = rule.reset, rule.arm, rule.update


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.floats(-1, 6), st.sampled_from(["onset", "start"]))
def test_threshold_shortcut_agrees_with_asking_step_by_step(seed, threshold, arming):
    panel = Panel(random_table(seed), arming)
    rule = ThresholdRule("total", threshold)
    np.testing.assert_array_equal(panel.handover_of(rule), panel.handover_of(WithoutShortcut(rule)))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["onset", "start"]))
def test_best_threshold_is_the_best_of_all_thresholds(seed, arming):
    panel = Panel(random_table(seed), arming)
    _, best = panel.best_threshold("total")
    handovers = [panel.handover_of(ThresholdRule("total", value)) for value in np.arange(-1, 6.5, 0.5)]
    every = [panel.returns(handover).mean() for handover in handovers]
    assert best == pytest.approx(max(every))


@given(st.integers(0, 10_000), st.integers(0, HORIZON + 1), st.sampled_from(["onset", "start"]))
def test_delay_rule_hands_over_after_the_delay(seed, delay, arming):
    panel = Panel(random_table(seed), arming)
    expected = panel.executed(panel.arming_step + delay)
    np.testing.assert_array_equal(panel.handover_of(DelayRule(delay)), expected)


def test_return_counts_learner_steps_from_the_arming_step_and_phi_on_success():
    outcome = np.ones((1, HORIZON + 1), bool)
    table = new_table(
        np.array([0]), np.array([4]), np.array([HORIZON]), np.array([True]), {"total": np.zeros((1, HORIZON))}, outcome
    )
    assert Panel(table, "onset").returns(np.array([7]), phi=5.0)[0] == pytest.approx(3 / HORIZON + 5)
    assert Panel(table, "start").returns(np.array([7]), phi=2.0)[0] == pytest.approx(7 / HORIZON + 2)


def test_t_first_and_t_last_by_hand():
    outcome = np.zeros((3, HORIZON + 1), bool)
    outcome[0, [2, 3, 4, 6]] = True  # onset 2: unbroken until 4, once more at 6
    outcome[1, [0, 1]] = True  # onset 2: no recoverable step
    outcome[2, :] = True  # the learner alone succeeds
    table = new_table(
        np.arange(3),
        np.array([2, 2, 2]),
        np.array([10, 10, HORIZON]),
        np.array([False, False, True]),
        {},
        outcome,
    )
    np.testing.assert_array_equal(table.t_first, [4, np.nan, HORIZON])
    np.testing.assert_array_equal(table.t_last, [6, np.nan, HORIZON])


@given(st.integers(0, 10_000))
def test_t_first_by_definition(seed):
    table = random_table(seed)
    for episode in range(len(table)):
        onset, length = table.onset[episode], table.length[episode]
        known = table.known()[episode]
        good = [s for s in range(onset, length) if known[onset : s + 1].all()]
        last = [s for s in range(onset, length) if known[s]]
        if table.learner_success[episode]:
            assert table.t_first[episode] == table.t_last[episode] == HORIZON
        else:
            np.testing.assert_equal(table.t_first[episode], float(good[-1]) if good else np.nan)
            np.testing.assert_equal(table.t_last[episode], float(last[-1]) if last else np.nan)


def test_onset_arming_refuses_undisturbed_episodes():
    with pytest.raises(ValueError, match="disturbed"):
        Panel(random_table(0, disturbed=False), "onset")


def test_unknown_signal_names_the_valid_ones():
    with pytest.raises(ValueError, match="total"):
        Panel(random_table(0), "start").signal("totl")


def test_table_round_trip(tmp_path):
    table = concatenate([random_table(1), random_table(2, disturbed=False)])
    table.save(tmp_path / "table.npz")
    again = HandoverTable.load(tmp_path / "table.npz")
    np.testing.assert_array_equal(again.known(), table.known())
    for name in ("seeds", "onset", "length", "learner_success"):
        np.testing.assert_array_equal(getattr(again, name), getattr(table, name))
    np.testing.assert_array_equal(again.signals["total"], table.signals["total"])


@given(st.integers(0, 10_000))
def test_margins_hold_exactly_the_worthwhile_thresholds_around_the_best(seed):
    panel = Panel(random_table(seed), "onset")
    low, high = panel.margins("total")
    best, value = panel.best_threshold("total")
    if np.isnan(low):
        assert value <= panel.trivial_return()
        return
    assert low <= best < high
    inside = [low, best]
    for threshold in inside:
        assert panel.returns(panel.handover_at("total", threshold)[0]).mean() > panel.trivial_return()
    if np.isfinite(high):
        assert panel.returns(panel.handover_at("total", high)[0]).mean() <= panel.trivial_return()


@given(st.integers(0, 10_000), st.sampled_from(["onset", "start"]), st.sampled_from([0.05, 5.0]))
def test_hindsight_oracle_earns_the_maximum_over_all_steps_and_never(seed, arming, phi):
    panel = Panel(random_table(seed), arming)
    oracle = OracleHindsight().calibrate(Calibration(panel, panel.table, phi))
    chosen = panel.returns(panel.handover_of(oracle.rule), phi)
    for episode in range(len(panel)):
        one = panel.take(np.array([episode]))
        steps = [*range(int(one.arming_step[0]), int(one.table.length[0])), HORIZON]
        assert chosen[episode] == pytest.approx(max(one.returns(np.array([step]), phi)[0] for step in steps))


def test_unknown_outcomes_are_resolved_once_and_shared_with_parts():
    calls = []
    unknown = np.full((2, HORIZON + 1), -1)
    success = np.array([False, True])
    base = new_table(np.arange(2), np.array([1, 1]), np.array([5, HORIZON]), success, {}, unknown)
    base.sources[0].resolve = lambda episode, step: calls.append((episode, step)) or step < 3
    joined = concatenate([base.take(np.array([0])), base])
    assert joined.outcome(np.array([0, 0, 1]), np.array([2, 4, 4])).tolist() == [True, False, False]
    assert sorted(calls) == [(0, 2), (0, 4)]
    assert base.outcome(np.array([1, 0]), np.array([HORIZON, 2])).tolist() == [True, True]
    assert len(calls) == 2


def test_unknown_outcomes_without_a_simulator_are_an_error():
    table = new_table(np.arange(1), np.array([1]), np.array([5]), np.array([False]), {}, np.full((1, HORIZON + 1), -1))
    with pytest.raises(LookupError, match="without a simulator"):
        table.outcome(np.array([0]), np.array([2]))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["onset", "start"]), st.sampled_from([0.5, 5.0]))
def test_the_best_row_is_found_without_asking_for_every_outcome(seed, arming, phi):
    whole = random_table(seed)
    truth, asked = whole.known(), []
    hidden = np.where(np.arange(HORIZON + 1) < whole.length[:, None], UNKNOWN, truth)
    lazy = new_table(whole.seeds, whole.onset, whole.length, whole.learner_success, whole.signals, hidden)

    def resolve(episode, step):
        asked.append((episode, step))
        return int(truth[episode, step])

    lazy.sources[0].resolve = resolve
    complete, panel = Panel(whole, arming), Panel(lazy, arming)
    rows = complete.handover_at("total", complete.candidate_thresholds("total"))
    means = complete.returns(rows, phi).mean(axis=1)
    assert panel.best_of(rows, phi) == (int(np.argmax(means)), float(means.max()))
    assert len(asked) == len(set(asked))
    # A row whose return would be too low even with success everywhere is never asked about.
    hopeless = complete.armed_learner_steps(rows).mean(axis=1) / HORIZON + phi < means.max() - 1e-9
    needed = {(e, s) for row in rows[~hopeless] for e, s in enumerate(row)}
    assert set(asked) <= needed


def test_the_solvers_failures_are_failures_and_are_listed():
    outcome = np.ones((2, HORIZON + 1), np.int8)
    outcome[0, 3], outcome[0, 4], outcome[1, 5] = SOLVER_FAILURE, 0, SOLVER_FAILURE
    length = np.array([HORIZON, 4])  # the second ends before the step at which the solver would have failed
    alone = np.array([True, False])
    table = new_table(np.array([7, 8]), np.array([2, 2]), length, alone, {}, outcome)
    assert not Panel(table, "onset").success(np.array([3, 3]))[0] and Panel(table, "onset").success(np.array([3, 3]))[1]
    row = failure_table([(Cell("cart-pole", "push", 3, "other"), 1, table)]).iloc[0]
    assert row[["episodes", "learner_failures", "learner_early_ends"]].tolist() == [2, 1, 1]
    assert row[["outcomes", "expert_failures", "solver_failures"]].tolist() == [HORIZON + 4, 2, 1]
    assert row["solver_failure_seeds"] == "7"
