"""Published handover tables: compact files of one task, from which latched rules are scored without a simulator.

A folder holds one file per (cell, split, learner), `<disturbance>-<severity>-<split>-learner<seed>.npz`, as the full
profile writes them to `results/tables/<task>/`. The split is part of the name, and the episode seeds inside must be of
that split: nothing is calibrated on what it is tested on.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from safeswitch.handover.outcomes import UNKNOWN
from safeswitch.handover.panel import Panel
from safeswitch.handover.table import HandoverTable, concatenate
from safeswitch.names import unknown
from safeswitch.protocols import ARMINGS, Arming
from safeswitch.suite import SPLIT_SIZE, SPLITS, Cell, Split

_NAME = re.compile(r"(?P<disturbance>.+)-(?P<severity>\d+)-(?P<split>calibrate|test)-learner(?P<learner>\d+)\.npz")


def file_name(disturbance: str, severity: int, split: Split, learner: int) -> str:
    """Name of the file of one (cell, split, learner seed)."""
    return f"{disturbance}-{severity}-{split}-learner{learner}.npz"


AGAIN = "publish the tables again with `safeswitch bench --profile full`"
"""Remedy of tables that lack something."""


@dataclass(frozen=True)
class PublishedTables:
    """The tables of one task in a folder.

    Attributes:
        folder: where they are; its name is the task's.
        files: (disturbance, severity, split, learner seed) -> file; disturbances as in tables (`Cell.label`).
    """

    folder: Path
    files: dict[tuple[str, int, str, int], Path]

    @staticmethod
    def find(folder: Path | str) -> PublishedTables:
        """The tables in `folder`.

        Raises:
            ValueError: there are none, or two files claim to be the same table.
        """
        folder = Path(folder)
        files: dict[tuple[str, int, str, int], Path] = {}
        for path in sorted(folder.glob("*.npz")):
            if match := _NAME.fullmatch(path.name):
                key = (match["disturbance"], int(match["severity"]), match["split"], int(match["learner"]))
                if key in files:
                    raise ValueError(f"{files[key].name} and {path.name} in {folder} are the same table: keep one")
                files[key] = path
        if not files:
            example = file_name("cart-mass", 3, "test", 0)
            raise ValueError(f"{folder} holds no handover tables: expected files such as {example}")
        return PublishedTables(folder, files)

    @property
    def task(self) -> str:
        """Name of the task."""
        return self.folder.absolute().name

    @property
    def learners(self) -> list[int]:
        """Learner seeds."""
        return sorted({learner for _, _, _, learner in self.files})

    @property
    def cells(self) -> list[tuple[str, int]]:
        """(disturbance, severity) with test episodes, sorted; `none` has severity 0."""
        return sorted({(name, severity) for name, severity, split, _ in self.files if split == "test"})

    def has(self, disturbance: str, severity: int, split: Split, learner: int) -> bool:
        """Whether there is such a table."""
        return (disturbance, severity, split, learner) in self.files

    def load(self, disturbance: str, severity: int, split: Split, learner: int) -> HandoverTable:
        """One table.

        Raises:
            ValueError: there is none, or its episodes are not of that split.
        """
        name = file_name(disturbance, severity, split, learner)
        if not self.has(disturbance, severity, split, learner):
            known = (file_name(*key) for key in self.files)  # type: ignore[arg-type]
            raise unknown(f"handover table in {self.folder}", name, known)
        path = self.files[disturbance, severity, split, learner]
        table = HandoverTable.load(path)
        first = SPLITS.index(split) * SPLIT_SIZE
        if ((table.seeds < first) | (table.seeds >= first + SPLIT_SIZE)).any():
            of = sorted({SPLITS[int(seed) // SPLIT_SIZE] for seed in table.seeds})
            raise ValueError(f"{path} holds episodes of {', '.join(of)}, not of {split}")
        return table

    def panel(self, disturbance: str, severity: int, split: Split, learner: int, arming: Arming) -> Panel:
        """Episodes of a cell under an arming; under `start` with their undisturbed twins."""
        table = self.load(disturbance, severity, split, learner)
        twins = undisturbed(disturbance)
        nominal = self.load(twins, 0, split, learner) if arming == "start" and disturbance != twins else None
        return panel_of(table, nominal, arming)

    def complete_panel(self, disturbance: str, severity: int, split: Split, learner: int, arming: Arming) -> Panel:
        """The same, refused where an outcome is unknown."""
        panel = self.panel(disturbance, severity, split, learner, arming)
        known = panel.table.known()
        if missing := int((known == UNKNOWN).sum()):
            raise ValueError(
                f"{missing} of {known.size} outcomes of {self.task}/{disturbance}-{severity} (learner {learner}, "
                f"{split}) are unknown, and there is no simulator here to compute them: {AGAIN}"
            )
        return panel


def panel_of(table: HandoverTable, nominal: HandoverTable | None, arming: Arming) -> Panel:
    """Episodes under an arming: disturbed ones, and under `start` their undisturbed twins beside them.

    `nominal` may hold further episodes after those of the table's seeds.
    """
    if arming not in ARMINGS:
        raise unknown("arming", arming, ARMINGS)
    if nominal is not None and arming == "start":
        twins = nominal.take(np.arange(min(len(table), len(nominal))))
        if not np.array_equal(twins.seeds, table.seeds):
            raise ValueError(f"undisturbed episodes of seeds {twins.seeds} are no twins of episodes of {table.seeds}")
        return Panel(concatenate([table, twins]), arming)
    return Panel(table, arming)


def armings_of(disturbance: str) -> tuple[Arming, ...]:
    """Armings under which a cell is scored: without a disturbance there is no onset."""
    return ("start",) if disturbance == undisturbed(disturbance) else ARMINGS


def undisturbed(disturbance: str) -> str:
    """Label of the undisturbed cell beside a cell's: "none", on the same track."""
    _, at, track = disturbance.partition("@")
    return "none" + at + track


def write_table(table: HandoverTable, folder: Path, cell: Cell, split: Split, learner: int) -> Path:
    """Write a table, complete and without snapshots, to `folder`."""
    if (np.asarray(table.known()) == UNKNOWN).any():
        raise ValueError(f"the table of {cell}, {split}, learner {learner}, has unknown outcomes: complete it first")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / file_name(cell.label, cell.severity, split, learner)
    table.save(path, snapshots=False)
    return path
