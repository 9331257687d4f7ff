"""Options that several commands share: which run, and who is scored where."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from safeswitch import suite
from safeswitch.console import set_output

if TYPE_CHECKING:
    from safeswitch.evaluation import Evaluation
    from safeswitch.pipeline import Run


@dataclass
class Output:
    """What is shown.

    Attributes:
        json: put the answer on standard output as one JSON document.
        quiet: print errors only (and the JSON document, if it is asked for).
    """

    json: bool = False
    quiet: bool = False

    def set(self) -> None:
        """Show no more than what was asked for."""
        set_output(self.quiet, self.json)


@dataclass
class Common(Output):
    """Options that every command on runs shares.

    Attributes:
        profile: how much is run: smoke, standard or full.
        task: one task only; all tasks where it is left out.
        jobs: processes at a time (default: the number of cores); results do not depend on it.
        store: folder of finished work (default: .safeswitch/store in the checkout, or $SAFESWITCH_STORE).
    """

    profile: str = "standard"
    task: str | None = None
    jobs: int | None = None
    store: Path | None = None

    def runs(self) -> list:
        """One run per task."""
        from safeswitch.pipeline import Run
        from safeswitch.store import Store

        self.set()
        if self.jobs is not None and self.jobs < 1:
            raise ValueError(f"--jobs must be at least 1, got {self.jobs}")
        tasks = [suite.task(self.task)] if self.task else list(suite.TASKS.values())
        return [Run(task, suite.profile(self.profile), Store(self.store), self.workers) for task in tasks]

    @property
    def workers(self) -> int:
        """Processes at a time."""
        from joblib import cpu_count

        return self.jobs or cpu_count()


@dataclass
class Contestant:
    """Who is scored, and where.

    Attributes:
        learner: registered learner or package.module:factory (default: the task's own).
        rule: id such as cem@total; rule and signal may each be package.module:factory.
        signals: further signals to record; those that the rule says it reads are recorded anyway.
        disturbance: disturbance of the cell (default: the paper's).
        severity: 1 to 5.
        protocol: onset or start.
    """

    learner: str | None = None
    rule: Annotated[str, tyro.conf.arg(aliases=["--method"])] = "cem@total"
    signals: tuple[str, ...] = ()
    disturbance: str | None = None
    severity: int = 3
    protocol: str = "onset"

    def evaluate(self, run: Run) -> Evaluation:
        """Score it in a run."""
        from safeswitch.evaluation import evaluate

        return evaluate(
            run, self.rule, self.disturbance, self.severity, self.protocol, self.learner, tuple(self.signals)
        )
