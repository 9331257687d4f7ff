"""Handover tables without a simulator: arbitrary ones, and one whose best threshold is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safeswitch.handover.panel import Calibration, Panel
from safeswitch.handover.table import HandoverTable, concatenate, new_table
from safeswitch.protocols import Arming

HORIZON = 12


def random_table(
    seed: int, episodes: int = 6, disturbed: bool = True, signals: Sequence[str] = ("total",)
) -> HandoverTable:
    """A table with arbitrary traces and outcomes, early ends included."""
    rng = np.random.default_rng(seed)
    success = rng.random(episodes) < 0.5
    length = np.where(success, HORIZON, rng.integers(7, HORIZON + 1, episodes))
    onset = rng.integers(1, 6, episodes) if disturbed else np.full(episodes, -1)
    outcome = rng.random((episodes, HORIZON + 1)) < 0.6
    ended = np.arange(HORIZON + 1)[None, :] >= length[:, None]
    outcome = np.where(ended, success[:, None], outcome)
    traces = {}
    for name in signals:
        traces[name] = rng.integers(0, 6, (episodes, HORIZON)).astype(float)  # ties on purpose
        traces[name][ended[:, :-1]] = np.nan
    return new_table(np.arange(episodes), onset, length, success, traces, outcome)


def random_calibration(seed: int, arming: Arming, signals: Sequence[str] = ("total",)) -> Calibration:
    """Arbitrary calibrate episodes under an arming, with undisturbed ones beside them."""
    return calibration(random_table(seed, signals=signals), random_table(seed + 1, 6, False, signals), arming, seed)


def calibration(disturbed: HandoverTable, nominal: HandoverTable, arming: Arming, seed: int = 0) -> Calibration:
    """Calibrate episodes as a run puts them together: under `start` the undisturbed ones make up half."""
    table = concatenate([disturbed, nominal]) if arming == "start" else disturbed
    return Calibration(Panel(table, arming), nominal, seed=seed)


def cliff_table(
    edge: float,
    episodes: int = 40,
    disturbed: bool = True,
    seed: int = 0,
    T: int = 80,
    noise: float = 0.3,
    rates: tuple[float, float] = (0.03, 0.05),
) -> HandoverTable:
    """Episodes that succeed for exactly the thresholds below `edge`; the learner alone fails every disturbed one.

    The signal is a twentieth of the edge until t0, grows from there to one and a half times the edge, and equals the
    edge at the step whose alarm is the last one in time. The later the handover the higher the return, so it grows with
    the threshold and drops at the edge. `noise` is the standard deviation of its logarithm before t0; `rates` are the
    slowest and the fastest growth of it, in ln 40 a step.
    """
    rng = np.random.default_rng(seed)
    onset = rng.integers(8, 40, episodes) if disturbed else np.full(episodes, -1)
    step = np.arange(T)[None, :]
    trace = edge * 0.05 * np.exp(noise * rng.standard_normal((episodes, T)))
    rate = rng.uniform(*rates, (episodes, 1)) * np.log(40)
    growth = edge * 0.05 * np.exp(rate * np.clip(step - onset[:, None], 0, None))
    trace = np.where(disturbed & (step >= onset[:, None]), np.minimum(growth, 1.5 * edge), trace)
    last = np.argmax(trace > edge, axis=1) - 1
    if disturbed:
        trace[np.arange(episodes), last] = edge
    outcome = (np.arange(T + 1)[None, :] <= last[:, None] + 1) | (not disturbed)
    success = np.full(episodes, not disturbed)
    seeds = np.arange(episodes)
    return new_table(seeds, onset, np.full(episodes, T), success, {"total": trace}, outcome)
