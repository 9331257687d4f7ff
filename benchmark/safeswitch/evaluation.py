"""One method in one cell, with the suite's learner or anybody's: what `safeswitch evaluate` and `submit` compute."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from safeswitch import factories, registry, scoring_stages, stages, trained
from safeswitch.evaluate import checked_arming, find_cell
from safeswitch.protocols import Arming, Driver
from safeswitch.scoring.leaderboard import leaderboard
from safeswitch.scoring.metrics import CELL, signal_of
from safeswitch.scoring.rows import latched_rows

if TYPE_CHECKING:
    from safeswitch.handover.panel import Panel
    from safeswitch.handover.table import HandoverTable
    from safeswitch.pipeline import Run
    from safeswitch.protocols import Calibrated, Method
    from safeswitch.suite import Cell, Task

REFERENCES = ("learner", "expert", "timer")


@dataclass(frozen=True)
class Evaluation:
    """What was found for one method.

    Attributes:
        run: the learner, the profile and the store that it was found with.
        method: id of the method.
        cell: where.
        protocol: arming.
        episodes: rows of `scoring.rows` of the method and of its references.
        scores: the leaderboard's row of the method.
    """

    run: Run
    method: str
    cell: Cell
    protocol: Arming
    episodes: pd.DataFrame
    scores: dict[str, Any]


def score_rows(scores: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Scores for people: (name, value, 95 % interval), with the interval beside its score and a dash for no value.

    Args:
        scores: the leaderboard's row.
    """
    rows = []
    for name, value in scores.items():
        if name in (*CELL, "method") or name.endswith(("_lo", "_hi")) or value == "":
            continue
        prefix = name.removesuffix("_mean")
        bounds = [scores.get(f"{prefix}_{end}", np.nan) for end in ("lo", "hi")]
        interval = "" if pd.isna(bounds).any() else f"{bounds[0]:.4g} to {bounds[1]:.4g}"
        said = "–" if pd.isna(value) else f"{value:.4g}" if isinstance(value, float) else str(value)
        rows.append((name, said, interval))
    return rows


def evaluate(
    run: Run,
    method_id: str,
    disturbance: str | None = None,
    severity: int = 3,
    protocol: str = "onset",
    learner: str | None = None,
    signals: Sequence[str] = (),
) -> Evaluation:
    """Score a method, exactly from the handover table where it is latched and by plain episodes elsewhere.

    Args:
        run: task, profile and store.
        method_id: `rule@signal` or `rule`; the rule, and the signal, may be `package.module:factory`.
        disturbance: of the cell, None for the paper's.
        severity: 1 to 5.
        protocol: onset or start.
        learner: a learner's name or `package.module:factory`; None for the task's own.
        signals: signals to record besides those that the method says it reads.
    """
    arming, cell = checked_arming(protocol), find_cell(run.task, disturbance, severity)
    if arming not in scoring_stages.protocols_of(cell):
        raise ValueError(f"cell {cell} has no onset: score it with --protocol start")
    method = registry.make_method(method_id)
    run = with_method(run, method, method_id, learner, signals)
    episodes = score_episodes(run, method_id, cell, arming)
    table = leaderboard(episodes, {run.task.name: run.task_info})
    return Evaluation(run, method_id, cell, arming, episodes, dict(table[table["method"] == method_id].iloc[0]))


def with_method(run: Run, method: Method, method_id: str, learner: str | None, signals: Sequence[str] = ()) -> Run:
    """The same run with another learner, and with the signals that a method reads.

    The task's own learner keeps the task's signals, so that what `bench` has computed is used.
    """
    wanted = [signal_of(method_id), *getattr(method, "reads", ()), *signals]
    read = dict.fromkeys(signal for signal in wanted if signal)
    for signal in read:
        registry.find("signal", registry.base_signal(signal))
    task, profile = run.task, run.profile
    own = learner in (None, task.learner)
    if not own:
        factory = registry.find("learner", str(learner))
        if not factories.is_kept(factory) and factories.parameters(str(learner), factory) == []:
            profile = replace(profile, learners=1)  # a ready-made learner without a seed is one learner
        profile = replace(profile, learner_options={})
        task = replace(task, learner=str(learner), learner_options={}, literal="")
    kept = tuple(dict.fromkeys([*(task.signals if own else ()), *read]))
    alone = [signal for signal in read if profile.learners == 1 and trained.needs_members(signal)]
    if alone:
        raise ValueError(
            f"signal {alone[0]!r} needs learners of several seeds; there is one: use --profile full, and a factory "
            "that takes a seed"
        )
    if kept == run.task.signals and own:
        return run
    return type(run)(replace(task, signals=kept), profile, run.store, run.workers)


def score_episodes(run: Run, method_id: str, cell: Cell, arming: Arming) -> pd.DataFrame:
    """Rows of the method and of its references on the test episodes of a cell, for every learner seed."""
    signal = signal_of(method_id)
    names = dict.fromkeys([*REFERENCES, *([f"best@{signal}"] if signal else []), method_id])
    frames = []
    for seed in range(len(run.learners)):
        loaded = run.tables_of(seed, cell).load(run.store, run.task, cell)
        check_signals(run.task, loaded.values())
        test = scoring_stages.test_panel(loaded, cell, arming)
        calibration = scoring_stages.calibration_of(loaded, run.task, cell, arming, seed)
        for name in names:
            method = registry.make_method(name)
            calibrated = method.calibrate(calibration)
            if calibrated.rule is None:
                raise ValueError(f"{name} cannot have what it asks for in cell {cell} under {arming}: the row is blank")
            if method.latched:
                check_rule(name, method, calibrated, test)
                rows = latched_rows(test, calibrated)
            else:
                rows = scoring_stages.plain_rows(run.task, cell, run.trained[seed], test, method, calibrated.rule)
            frames.append(scoring_stages.labelled(rows, cell, arming, name, seed, calibrated, ""))
    return stages.concat(frames)


def check_signals(task: Task, tables: Any) -> None:
    """Refuse signals without a value: no rule on them would ever hand over."""
    table: HandoverTable
    for table in tables:
        for name, trace in table.signals.items():
            steps = np.arange(table.horizon)[None, :] < table.length[:, None]
            if np.isnan(trace[steps]).any():
                raise ValueError(
                    f"signal {name!r} has no value (NaN) with the learner {task.learner!r}: give the variances that it "
                    "needs in the Prediction, or use a rule on a signal of your own"
                )


def check_rule(name: str, method: Method, calibrated: Calibrated, panel: Panel) -> None:
    """Refuse a latched rule from outside that is not what it says.

    One that can be asked step by step must answer as its `handover_steps` does, if it has that short cut, and must not
    take its word back; one that cannot be asked looks at the table and has to say so.
    """
    if ":" not in name:
        return
    rule = calibrated.rule
    if not hasattr(rule, "update"):
        if "privileged" not in method.needs:
            raise ValueError(f"rule {name!r} cannot drive an episode (no `update`): add 'privileged' to its needs")
        return
    steps = panel.handover_of(rule)
    for episode in range(len(panel)):
        drivers = _answers(rule, panel, episode)
        first = next((step for step, driver in drivers if driver == Driver.EXPERT), panel.table.horizon)
        if any(step > first and driver == Driver.LEARNER for step, driver in drivers):
            raise ValueError(
                f"rule {name!r} gives control back (episode {panel.table.seeds[episode]}, after step {first}): say so "
                "with `latched = False`"
            )
        if panel.executed(np.array([first] * len(panel)))[episode] != steps[episode]:
            raise ValueError(
                f"rule {name!r} contradicts itself in episode {panel.table.seeds[episode]}: asked step by step it "
                f"hands over at {first}, its handover_steps say {steps[episode]}"
            )


def _answers(rule: Any, panel: Panel, episode: int) -> list[tuple[int, int]]:
    """(step, driver) of every armed step, whatever the rule answered before."""
    table, start = panel.table, int(panel.arming_step[episode])
    rule.reset(int(table.seeds[episode]))
    answers = [(start, rule.arm(start))]
    for step in range(start, int(table.length[episode])):
        values = {name: float(trace[episode, step]) for name, trace in table.signals.items()}
        answers.append((step + 1, rule.update(step, values)))
    return answers
