"""Scores any latched rule on published handover tables: in seconds, exactly, and without a simulator."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from safeswitch import registry, suite
from safeswitch.handover.panel import Calibration
from safeswitch.handover.published import AGAIN, PublishedTables, armings_of, undisturbed
from safeswitch.protocols import Arming, Calibrated
from safeswitch.scoring.leaderboard import leaderboard
from safeswitch.scoring.metrics import REFERENCES, TaskInfo
from safeswitch.scoring.rows import latched_rows

IN_STEPS = ("margin_s", "delay_s")
"""Scores that are given in control steps: the tables do not know how long a step is."""

Calibrator = Callable[[PublishedTables, str, int, int, Arming], Calibrated]
"""(tables, disturbance, severity, learner seed, arming) -> the calibrated method."""


def find_tables(folder: Path) -> list[PublishedTables]:
    """Tables of one task (`results/tables/cart-pole`), or of every task below a folder (`results/tables`)."""
    if not folder.is_dir():
        raise ValueError(f"--tables {folder}: there is no such folder; results/tables holds the committed ones")
    if any(folder.glob("*.npz")):
        return [PublishedTables.find(folder)]
    found = [PublishedTables.find(below) for below in sorted(folder.iterdir()) if any(below.glob("*.npz"))]
    if not found:
        raise ValueError(f"--tables {folder}: neither it nor a folder in it holds handover tables (*.npz)")
    return found


@dataclass(frozen=True)
class Scored:
    """Leaderboard rows, and the cells that could not be scored, each with the reason."""

    table: pd.DataFrame
    left_out: list[str]


class _UnattainableError(Exception):
    """A method has no rule in a cell, such as one that asks for an expert share that no threshold gives."""


def score_rule(tables: PublishedTables, name: str) -> Scored:
    """Leaderboard rows of a ready rule, `package.module:factory`; the factory takes no argument.

    The rule is a `safeswitch.protocols.SwitchRule`. Once it names the expert it is taken at its word: the handover is
    final.
    """
    rule = registry.find("method", name)()
    if not (hasattr(rule, "update") or hasattr(rule, "handover_steps")):
        advice = "it is a method: use --method" if hasattr(rule, "calibrate") else "see protocols.SwitchRule"
        raise ValueError(f"{name} makes a {type(rule).__name__}, which has no update(step, signals); {advice}")
    return _score(tables, {name: lambda *_: Calibrated(rule)}, name)


def score_method(tables: PublishedTables, name: str) -> Scored:
    """Leaderboard rows of a method, calibrated on the published calibrate episodes as in the benchmark."""
    method = registry.make_method(name)
    if not method.latched:
        raise ValueError(f"{name} gives control back: the tables are for latched rules, run it with bench")
    signal = name.partition("@")[2]
    measured = signal in _signals(tables)
    names = dict.fromkeys([*REFERENCES, *([f"best@{signal}"] if measured else []), name])
    return _score(tables, {each: _calibrator(each) for each in names}, name)


def _calibrator(name: str) -> Calibrator:
    """Calibration as in the benchmark: on the cell itself, or on the one that its thresholds come from."""

    def calibrate(tables: PublishedTables, label: str, severity: int, learner: int, arming: Arming) -> Calibrated:
        task = suite.task(tables.task)
        cell = next(each for each in task.cells if (each.label, each.severity) == (label, severity))
        on = task.calibrated_on(cell)
        if not tables.has(on.label, on.severity, "calibrate", learner):
            raise ValueError(
                f"{tables.folder} has no calibrate episodes of {on} (learner {learner}): {name} cannot be calibrated: "
                f"{AGAIN}, or give a ready rule with --rule"
            )
        panel = tables.panel(on.label, on.severity, "calibrate", learner, arming)
        nominal = tables.load(undisturbed(on.label), 0, "calibrate", learner)
        return registry.make_method(name).calibrate(Calibration(panel, nominal, seed=learner))

    return calibrate


def _signals(tables: PublishedTables) -> list[str]:
    disturbance, severity = tables.cells[0]
    return sorted(tables.load(disturbance, severity, "test", tables.learners[0]).signals)


def _score(tables: PublishedTables, methods: dict[str, Calibrator], wanted: str) -> Scored:
    frames, left_out = [], []
    for disturbance, severity in tables.cells:
        for arming in armings_of(disturbance):
            try:
                frames += list(_rows(tables, methods, disturbance, severity, arming))
            except LookupError as error:  # an outcome that the rule asks for is unknown
                left_out.append(f"{tables.task}/{disturbance}-{severity}, {arming}: {error}; {AGAIN}")
            except _UnattainableError as error:
                left_out.append(f"{tables.task}/{disturbance}-{severity}, {arming}: {error}")
    if not frames:
        raise ValueError("no cell can be scored: " + " | ".join(left_out))
    horizon = tables.load(*tables.cells[0], "test", tables.learners[0]).horizon
    table = leaderboard(pd.concat(frames), {tables.task: TaskInfo(horizon, 1.0)})
    table = table[table["method"] == wanted].reset_index(drop=True)
    names = {column: column.replace("_s", "_steps", 1) for column in table if column.startswith(IN_STEPS)}
    return Scored(table.rename(columns=names), left_out)


def _rows(
    tables: PublishedTables, methods: dict[str, Calibrator], disturbance: str, severity: int, arming: Arming
) -> Iterator[pd.DataFrame]:
    """Test episodes of one cell and arming, for every learner and method."""
    for learner in tables.learners:
        test = tables.panel(disturbance, severity, "test", learner, arming)
        for name, calibrate in methods.items():
            calibrated = calibrate(tables, disturbance, severity, learner, arming)
            if calibrated.rule is None:
                raise _UnattainableError(f"{name} cannot have what it asks for here (learner {learner})")
            yield latched_rows(test, calibrated).assign(
                task=tables.task,
                disturbance=disturbance,
                severity=severity,
                protocol=arming,
                method=name,
                learner=learner,
                threshold=calibrated.threshold,
                tuning_episodes=calibrated.tuning_episodes,
                expert_queries=calibrated.expert_queries,
            )


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows as plain values, for JSON; NaN becomes null when it is written."""
    return table.to_dict("records")  # type: ignore[return-value]
