"""What `gymnasium.make("SafeSwitch/CartPoleHandover-v0")` calls: the switching problem of a task, from its tables."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import get_args

from safeswitch.handover.env import HISTORY, Decisions, HandoverEnv, HandoverVectorEnv
from safeswitch.handover.panel import PHI, Panel
from safeswitch.handover.published import PublishedTables, armings_of, panel_of
from safeswitch.names import unknown
from safeswitch.protocols import Arming
from safeswitch.suite import Cell, Split, Task
from safeswitch.suite import task as find_task

SPLITS: tuple[Split, ...] = ("calibrate", "test")
"""Splits that a policy may see: `calibrate` to learn on, `test` to be scored on. The learner was trained on others."""
SIGNALS = ("epistemic", "aleatoric", "total")
"""Signals that are observed unless others are named: the paper's."""


def make(
    task: str,
    disturbance: str | None = None,
    severity: int = 3,
    arming: Arming = "start",
    split: Split = "calibrate",
    phi: float = PHI,
    signals: Sequence[str] = SIGNALS,
    history: int = HISTORY,
    episodes: int = 100,
    tables: str | Path | None = None,
    learner: int = 0,
) -> HandoverEnv:
    """The switching problem in one cell.

    Args:
        task: name of the task; the ids set it.
        disturbance: of the cell, or "none"; the paper's where it is left out.
        severity: 1 to 5.
        arming: "start": the monitor is on from step 0, half of the episodes are undisturbed; "onset": from t0 on.
        split: "calibrate" to train a policy, "test" to score it; they share no episode.
        phi: reward of success, in units of a whole episode driven by the learner.
        signals: ids of the observed signals.
        history: steps of each signal in an observation.
        episodes: of the reference learner, per cell; up to 100 are shipped for the paper's cell and `none`.
        tables: folder of published tables of this task, such as `results/tables/cart-pole`. Where it is left out the
            reference learner serves, that is shipped with the package: in the paper's cell and in `none` at once, in
            any other cell after its episodes were recorded once, which takes minutes.
        learner: seed of the learner in `tables`.
    """
    cell = (task, disturbance, severity, arming, split, episodes, None if tables is None else str(tables), learner)
    return HandoverEnv(_decisions(*cell, tuple(signals), history, float(phi)))


def make_vector(num_envs: int, *args: object, **kwargs: object) -> HandoverVectorEnv:
    """`num_envs` episodes at a time; the other arguments are those of `make`."""
    return HandoverVectorEnv(make(*args, **kwargs).decisions, num_envs)  # type: ignore[arg-type]


@lru_cache(maxsize=16)
def _decisions(
    task: str,
    disturbance: str | None,
    severity: int,
    arming: Arming,
    split: Split,
    episodes: int,
    tables: str | None,
    learner: int,
    signals: tuple[str, ...],
    history: int,
    phi: float,
) -> Decisions:
    """Shared by all environments of a process that are alike."""
    panel = _panel(task, disturbance, severity, arming, split, episodes, tables, learner)
    return Decisions(panel, signals, history, phi)


@lru_cache(maxsize=16)
def _panel(
    task_name: str,
    disturbance: str | None,
    severity: int,
    arming: Arming,
    split: Split,
    episodes: int,
    tables: str | None,
    learner: int,
) -> Panel:
    task = find_task(task_name)
    cell = find_cell(task, disturbance, severity)
    if split not in SPLITS:
        raise unknown("split", split, SPLITS)
    if arming not in get_args(Arming):
        raise unknown("arming", arming, get_args(Arming))
    if arming not in armings_of(cell.label):
        raise ValueError(f"cell {cell} has no onset: use arming='start'")
    if split == "calibrate" and cell.tag == "held-out":
        raise ValueError(f"cell {cell} is held out: train on {task.paper_cell} and score it here with split='test'")
    if tables is not None:
        return PublishedTables.find(tables).complete_panel(cell.label, cell.severity, split, learner, arming)
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    from safeswitch.reference import reference_table

    table = reference_table(task, cell, split, episodes)
    beside = arming == "start" and cell.tag != "none"
    nominal = reference_table(task, task.undisturbed(cell), split, episodes) if beside else None
    return panel_of(table, nominal, arming)


def find_cell(task: Task, disturbance: str | None, severity: int) -> Cell:
    """A cell of the task at any severity; an unknown one lists the valid ones, nearest first."""
    return task.find(disturbance, severity, (*task.cells, *task.severities(1, 2, 3, 4, 5)))
