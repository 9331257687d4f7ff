"""What the terminal shows: answers on standard output, progress and errors on standard error.

On a terminal each stage is a bar with the time left. Without a terminal, and under NO_COLOR or TERM=dumb, it is one
line of plain text a stage: no colours, no control characters. `--quiet` leaves errors only, `--json` puts one JSON
document on standard output in place of tables.
"""

from __future__ import annotations

import json as json_text
import os
import sys
import time
from types import TracebackType
from typing import Any, Literal

from rich.console import Console, RenderableType
from rich.progress import MofNCompleteColumn, ProgressColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as RichProgress
from rich.progress import Task as RichTask
from rich.progress_bar import ProgressBar
from rich.text import Text

from safeswitch.files import jsonable

COLOURS: Literal["auto"] | None = None if os.environ.get("NO_COLOR") else "auto"

console = Console(highlight=False, soft_wrap=True, color_system=COLOURS)
"""Answers: tables, paths, JSON."""
log = Console(highlight=False, soft_wrap=True, color_system=COLOURS, stderr=True)
"""Progress and errors."""

as_json = False
"""Whether answers are JSON; `set_output` sets it."""


class StageError(RuntimeError):
    """A stage of a run stopped with an error, its cause; what was finished before is kept."""


def set_output(quiet: bool = False, json: bool = False) -> None:
    """Choose what is shown from now on: errors only (`quiet`), JSON in place of tables."""
    global as_json
    as_json, log.quiet, console.quiet = json, quiet, quiet


def answer(data: Any, *shown: RenderableType) -> None:
    """Put the answer of a command on standard output: `shown` for people, or `data` as JSON."""
    if as_json:  # in full, with --quiet too: whoever asks for JSON reads it
        print(json_text.dumps(jsonable(data, "answer", nan_as_null=True), indent=1), file=sys.stdout, flush=True)
        return
    for each in shown:
        console.print(each)


def duration(seconds: float) -> str:
    """A time for people: 12 s, 3 min 05 s, 1 h 20 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def bars() -> bool:
    """Whether progress may move the cursor: on a terminal that can, unless NO_COLOR asks for plain text."""
    return log.is_terminal and not log.is_dumb_terminal and not os.environ.get("NO_COLOR") and not log.quiet


class Progress:
    """Progress of one stage: a bar on a terminal, one line elsewhere.

    Args:
        label: what is being done.
        total: number of jobs.
        done: how many of them were finished before.
        expected: guess of the wall time of the rest [s], used until the first job ends; None if there is none.
    """

    def __init__(self, label: str, total: int, done: int = 0, expected: float | None = None):
        self.label, self.total, self.done, self.expected = label, total, done, expected  # a label may be padded
        self._started = self._last = time.perf_counter()
        self._finished = 0  # jobs finished by this run
        self._bar: RichProgress | None = None
        if bars():
            columns = (SpinnerColumn(finished_text="[green]✓[/]"), TextColumn("{task.description}"), _Bar(self))
            self._bar = RichProgress(
                *columns, MofNCompleteColumn(), TimeElapsedColumn(), _TimeLeft(self), console=log, expand=False
            )

    def __enter__(self) -> Progress:
        if self._bar:
            self._bar.start()
            self._task = self._bar.add_task(self.label, total=self.total)
            self._bar.update(self._task, completed=self.done)  # finished at once where all was kept
        elif self.done < self.total:
            kept = f", {self.done} kept from before" if self.done else ""
            log.print(f"{self.label.rstrip()}: {self.total - self.done} to do{kept} ... ", end="")
            log.file.flush()
        return self

    def advance(self, label: str = "") -> None:
        """One more job is finished."""
        self._finished += 1
        self._last = time.perf_counter()
        if self._bar:
            self._bar.advance(self._task)

    @property
    def left(self) -> float | None:
        """Wall time left [s], from the jobs that this run has finished, else from the guess; None without either."""
        now, rest = time.perf_counter(), self.total - self.done - self._finished
        if rest <= 0:
            return 0.0
        if self._finished:
            return (self._last - self._started) / self._finished * rest - (now - self._last)
        return None if self.expected is None else self.expected - (now - self._started)

    @property
    def share(self) -> float:
        """Share of the stage that is over: of the time where what is left is known, else of the jobs."""
        left, elapsed = self.left, time.perf_counter() - self._started
        if left is None or left <= 0:
            return (self.done + self._finished) / max(self.total, 1)
        return 1 - (1 - self.done / self.total) * left / (elapsed + left)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        seconds = time.perf_counter() - self._started
        if self._bar:
            self._bar.stop()
        elif self.done == self.total and kind is None:
            log.print(f"{self.label.rstrip()}: kept from before")
        else:
            log.print(f"done in {seconds:.1f} s" if kind is None else f"stopped after {seconds:.1f} s")


class _Bar(ProgressColumn):
    """How much of a stage is over. One long job fills it, too, where it is known how long such a job takes."""

    def __init__(self, progress: Progress):
        self._progress = progress
        super().__init__()

    def render(self, task: RichTask) -> ProgressBar:
        """The bar."""
        share = 1.0 if task.finished else self._progress.share
        return ProgressBar(total=1.0, completed=share, width=24, complete_style="cyan", finished_style="green")


class _TimeLeft(ProgressColumn):
    """Time left of a stage, in words."""

    def __init__(self, progress: Progress):
        self._progress = progress
        super().__init__()

    def render(self, task: RichTask) -> Text:
        """What is left."""
        if self._progress.done == self._progress.total:
            return Text("kept from before", "dim")
        if task.finished:
            return Text("")
        left = self._progress.left
        if left is None:
            return Text("time left unknown", "dim")
        return Text("nearly done" if left < 1 else f"about {duration(left)} left", "cyan")
