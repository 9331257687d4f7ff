"""How fast thresholds are scored from the handover table, beside plain episodes in the same run; a decision's time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from safeswitch import registry, stages, suite
from safeswitch.handover.episode import run_episode
from safeswitch.handover.panel import Calibration, Panel
from safeswitch.pipeline import Run
from safeswitch.store import Store

THRESHOLDS = 10_000
SIGNALS = ("total", "epistemic", "aleatoric")


def handover_benchmark(profile: str = "smoke", repeats: int = 5) -> dict[str, Any]:
    """Time scoring from the table against plain episodes, on the first task's paper cell.

    Args:
        profile: whose first learner and calibrate episodes are used; computed first where the store lacks them.
        repeats: the fastest of so many is reported.

    Returns:
        Episodes, milliseconds for `THRESHOLDS` x `SIGNALS` from the table, what plain episodes would take for the
        same, their ratio, and percentiles of a decision (prediction, signals, rule).
    """
    task = next(iter(suite.TASKS.values()))
    run = Run(task, suite.profile(profile), Store())
    cell = task.paper_cell
    table = run.tables_of(0, cell).load(run.store, task, cell)["calibrate"].complete()
    thresholds = np.geomspace(0.01, 2.0, THRESHOLDS)

    def score() -> None:
        panel = Panel(table, "onset")  # a new one: its running maxima are not remembered
        for signal in SIGNALS:
            panel.returns(panel.handover_at(signal, thresholds)).mean(axis=1)

    from_table = min(_seconds(score) for _ in range(repeats))
    env = stages.make_env(task, cell)
    expert = env.make_expert()
    learner = stages.load_learner(task, str(run.store.folder(run.learners[0].key)))
    signals = [registry.make_signal(name) for name in SIGNALS]
    calibration = Calibration(Panel(table, "onset"), table)
    rule = registry.make_method("fixed-0.2@total").calibrate(calibration).rule

    def drive() -> None:
        for seed in table.seeds:
            run_episode(env, learner, signals, rule, expert, int(seed), "onset")

    plain = min(_seconds(drive) for _ in range(repeats)) / len(table)
    in_full = plain * len(table) * THRESHOLDS * len(SIGNALS)
    return {
        "episodes": len(table),
        "thresholds x signals": THRESHOLDS * len(SIGNALS),
        "from the table [ms]": 1e3 * from_table,
        "a plain episode [ms]": 1e3 * plain,
        "as plain episodes [h]": in_full / 3600,
        "ratio": in_full / from_table,
        **_decision(env, learner, signals, rule),
    }


def _decision(env: Any, learner: Any, signals: list[Any], rule: Any, decisions: int = 2000) -> dict[str, float]:
    """p50 and p95 [ms] of prediction, signals and rule at one step."""
    observation, _ = env.reset(seed=0)
    learner.reset(0)
    rule.reset(0)
    seconds = []
    for step in range(decisions):
        start = time.perf_counter()
        prediction = learner.predict(observation, step)
        rule.update(step, {signal.id: signal.update(observation, prediction, None) for signal in signals})
        seconds.append(time.perf_counter() - start)
    p50, p95 = np.percentile(seconds, [50, 95])
    return {"decision p50 [ms]": 1e3 * float(p50), "decision p95 [ms]": 1e3 * float(p95)}


def _seconds(call: Callable[[], None]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start
