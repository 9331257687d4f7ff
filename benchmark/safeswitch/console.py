"""What the terminal shows: rich progress with the time left, clean without a terminal and under NO_COLOR."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress

console = Console(highlight=False, soft_wrap=True)


class Progress:
    """Progress of one stage: a bar on a terminal, a line at the start and at the end elsewhere.

    Args:
        label: what is being done.
        total: number of jobs.
        done: how many of them were finished before.
    """

    def __init__(self, label: str, total: int, done: int = 0):
        self.label, self.total, self.done = label, total, done
        self._started = time.perf_counter()
        self._bar = (
            RichProgress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TimeRemainingColumn(),
                console=console,
            )
            if console.is_terminal and not console.quiet
            else None
        )

    def __enter__(self) -> Progress:
        if self._bar:
            self._bar.start()
            self._task = self._bar.add_task(self.label, total=self.total, completed=self.done)
        elif self.done < self.total:
            console.print(f"{self.label}: {self.total - self.done} of {self.total} to do")
        return self

    def advance(self, label: str = "") -> None:
        """One more job is finished."""
        if self._bar:
            self._bar.advance(self._task)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar:
            self._bar.stop()
        elif kind is None:
            console.print(f"{self.label}: done in {time.perf_counter() - self._started:.1f} s")
