"""What the page explores exactly: test episodes of a cell under an arming, as `Panel`s of the published tables."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from safeswitch.handover.panel import Panel
from safeswitch.handover.published import PublishedTables, armings_of, panel_of
from safeswitch.handover.table import HandoverTable, Ints, concatenate
from safeswitch.names import unknown
from safeswitch.protocols import Arming
from safeswitch.suite import Cell, Task


@dataclass(frozen=True)
class TaskTables:
    """The published handover tables of one task.

    Attributes:
        task: as in the suite.
        tables: (name of a cell, learner seed) -> its test episodes; a name is `label-severity`.
    """

    task: Task
    tables: dict[tuple[str, int], HandoverTable]

    @property
    def learners(self) -> list[int]:
        """Learner seeds."""
        return sorted({learner for _, learner in self.tables})

    @cached_property
    def cells(self) -> list[Cell]:
        """Cells that have a table of every learner, in the order of the suite."""
        every = [(name_of(cell), cell) for cell in self.task.cells]
        return [cell for name, cell in every if all((name, learner) in self.tables for learner in self.learners)]

    @property
    def signals(self) -> list[str]:
        """Signals that every table holds, in the order of the first."""
        first, *others = self.tables.values()
        return [name for name in first.signals if all(name in table.signals for table in others)]

    @property
    def horizon(self) -> int:
        """T [steps]."""
        return next(iter(self.tables.values())).horizon

    def stacked(self, cell: Cell) -> HandoverTable:
        """Episodes of a cell, learner after learner."""
        return concatenate([self.tables[name_of(cell), learner] for learner in self.learners])

    def views(self) -> Iterator[View]:
        """Every (cell, arming) that has all its tables: under `start` also those of the undisturbed twins."""
        for cell in self.cells:
            for protocol in armings_of(cell.label):
                if protocol == "onset" or self.task.undisturbed(cell) in self.cells:
                    yield View(self, cell, protocol)


@dataclass(frozen=True)
class View:
    """One cell under one arming, for all learners."""

    tables: TaskTables
    cell: Cell
    protocol: Arming

    @cached_property
    def panels(self) -> dict[int, Panel]:
        """Learner seed -> its panel, as it is scored."""
        return {learner: self._panel(learner) for learner in self.tables.learners}

    @cached_property
    def pooled(self) -> Panel:
        """All learners' episodes, learner after learner."""
        return Panel(concatenate([panel.table for panel in self.panels.values()]), self.protocol)

    def handover(self, signal: str, thresholds: list[float]) -> Ints:
        """(E,) handover steps of the pooled episodes, each learner at its own threshold."""
        pairs = zip(self.panels.values(), thresholds, strict=True)
        return np.concatenate([panel.handover_at(signal, np.array([value]))[0] for panel, value in pairs])

    def _panel(self, learner: int) -> Panel:
        tables, none = self.tables.tables, self.tables.task.undisturbed(self.cell)
        nominal = None if self.cell == none or self.protocol == "onset" else tables[name_of(none), learner]
        return panel_of(tables[name_of(self.cell), learner], nominal, self.protocol)


def name_of(cell: Cell) -> str:
    """Name of a cell in the names of files: `label-severity`."""
    return f"{cell.label}-{cell.severity}"


def tables_in(folder: Path, task: Task) -> TaskTables:
    """The test tables in a folder; an empty one has none."""
    if not any(folder.glob("*.npz")):
        return TaskTables(task, {})
    tables, known = {}, [name_of(cell) for cell in task.cells]
    for (disturbance, severity, split, learner), path in PublishedTables.find(folder).files.items():
        name = f"{disturbance}-{severity}"
        if name not in known:
            raise unknown("cell", name, known)
        if split == "test":
            tables[name, learner] = HandoverTable.load(path)
    return TaskTables(task, tables)
