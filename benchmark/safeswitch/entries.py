"""What the suite's entries are: a cell, and a task with everything that is fixed for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from safeswitch.names import unknown

Split = Literal["train", "design", "calibrate", "pilot", "test", "kept-back"]
Tag = Literal["paper", "none", "benign", "held-out", "other"]


@dataclass(frozen=True)
class Cell:
    """One (task, disturbance, severity). Severity is 0 for `none`.

    A `held-out` cell is the paper's disturbance as no calibration shows it: other kinds of it, or on another track.

    Attributes:
        task: name of the task.
        disturbance: name of the disturbance, or "none".
        severity: 1 to 5, 0 for "none".
        tag: what the cell is for.
        track: where the task is driven, if not where the learner was trained.
    """

    task: str
    disturbance: str
    severity: int
    tag: Tag
    track: str = ""

    def __str__(self) -> str:
        return f"{self.task}/{self.label}" + (f"-{self.severity}" if self.severity else "")

    @property
    def label(self) -> str:
        """Name of the disturbance as it stands in tables, with the track where that is another one."""
        return f"{self.disturbance}@{self.track}" if self.track else self.disturbance

    @property
    def left_out(self) -> bool:
        """Whether thresholds are also calibrated on the other disturbances: severity 3 of what does harm."""
        return self.severity == 3 and self.tag in ("paper", "other")

    def complete(self, split: Split) -> bool:
        """Whether every outcome is computed in advance: of tables that many rules, cells or figures come back to."""
        first = (self.tag == "none" and not self.track) or (self.tag == "paper" and self.severity == 3)
        return first or (self.left_out and split == "calibrate")

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Keyword arguments of `gymnasium.make`."""
        track = {"track": self.track} if self.track else {}
        return track if self.tag == "none" else {"disturbance": self.disturbance, "severity": self.severity, **track}


@dataclass(frozen=True)
class Task:
    """What is fixed for one task, chosen on the design split and then frozen.

    Attributes:
        name: as in the tables.
        env_id: Gymnasium id.
        learner: registered learner.
        learner_options: overrides of the learner's configuration.
        demonstrations: settings of `safeswitch.demos.collect` (episodes, noise).
        dataset: Minari dataset id.
        signals: ids of the signals recorded at every step.
        cells: every cell, the paper's severity 3 first, then `none`, then a benign one.
        modules: modules of this task alone, which its results depend on.
        assets: folders under `assets`, which its results depend on.
        showcase: signals that the figures show besides the paper's.
        literal: the learner as the paper describes it, where it is not the one above; it is reported beside it.
        literal_options: overrides of its configuration.
        ruled: signals that switch rules run on; all of them where it is empty.
        spared: names of cells that no profile runs, to save time; `evaluate` and `play` take them.
        others: most learners of other seeds that an ensemble asks beside its own; None for all of them.
        costly: whether an episode takes so long that a run must do without some: cells after the first three then have
            half the episodes, methods that ask for every outcome run only where the tables have them, signals are
            scored at the severities of the cells alone, rules that give control back run on a few episodes of the
            paper's cell, and one learner drives with other numbers of dropout samples.
    """

    name: str
    env_id: str
    learner: str
    dataset: str
    signals: tuple[str, ...]
    cells: tuple[Cell, ...]
    modules: tuple[str, ...]
    assets: tuple[str, ...]
    learner_options: Mapping[str, Any] = field(default_factory=dict, hash=False)
    demonstrations: Mapping[str, Any] = field(default_factory=dict, hash=False)
    showcase: tuple[str, ...] = ()
    literal: str = ""
    literal_options: Mapping[str, Any] = field(default_factory=dict, hash=False)
    ruled: tuple[str, ...] = ()
    spared: frozenset[str] = frozenset()
    others: int | None = None
    costly: bool = False

    @property
    def rule_signals(self) -> tuple[str, ...]:
        """Signals that switch rules run on."""
        return tuple(signal for signal in self.ruled or self.signals if signal in self.signals)

    @property
    def paper_cell(self) -> Cell:
        """The paper's disturbance at severity 3."""
        return next(cell for cell in self.cells if cell.tag == "paper" and cell.severity == 3)

    @property
    def none_cell(self) -> Cell:
        """The undisturbed cell."""
        return next(cell for cell in self.cells if cell.tag == "none")

    def find(self, disturbance: str | None, severity: int, cells: tuple[Cell, ...]) -> Cell:
        """One of `cells`, by default of the paper's disturbance; an unknown one lists the valid ones, nearest first."""
        disturbance = self.paper_cell.disturbance if disturbance is None else disturbance
        for cell in cells:
            if cell.label == disturbance and cell.severity in (severity, 0):
                return cell
        raise unknown("cell", f"{self.name}/{disturbance}-{severity}", map(str, cells))

    def undisturbed(self, cell: Cell) -> Cell:
        """The cell of the undisturbed twins of a cell's episodes."""
        return next(each for each in self.cells if each.tag == "none" and each.track == cell.track)

    def severities(self, *severities: int) -> tuple[Cell, ...]:
        """Cells of every disturbance at further severities, those that the task has already left out."""
        disturbed = {cell.disturbance: cell.tag for cell in self.cells if cell.tag != "none" and not cell.track}
        every = (Cell(self.name, name, severity, tag) for name, tag in disturbed.items() for severity in severities)
        return tuple(cell for cell in every if cell not in self.cells)

    def code(self) -> list[str | Path]:
        """Modules and asset folders whose content the physics of this task depends on."""
        from safeswitch.tasks.models import assets_folder  # imports mujoco

        return [*self.modules, *(assets_folder() / name for name in self.assets)]

    def calibrated_on(self, cell: Cell) -> Cell:
        """Thresholds of held-out cells, and of `none` and benign ones, in which nothing has to be saved, come from the
        paper's cell.
        """
        return self.paper_cell if cell.tag in ("none", "benign", "held-out") else cell


def others(cell: Cell, cells: tuple[Cell, ...]) -> tuple[Cell, ...]:
    """Those of `cells` that thresholds come from when the disturbance of `cell` is left out; none for cells that have
    no such rows.
    """
    found = tuple(each for each in cells if each.left_out and each.disturbance != cell.disturbance)
    return found if cell.left_out else ()
