"""When should a learned controller hand control back to an expert? Run, score and compare switch rules.

Exit codes: 0 done; 1 a check failed, or a stage stopped with an error; 2 bad input; 130 interrupted (Ctrl-C).
"""

from __future__ import annotations

import sys
import time
import traceback
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from safeswitch import commands, registry, submit_commands, suite
from safeswitch.console import StageError, answer, console, log
from safeswitch.interrupts import for_this_process_alone
from safeswitch.options import Common, Contestant, Output


@dataclass
class Bench:
    """Run the benchmark: demonstrations, training, handover tables, switch rules, leaderboard.

    Attributes:
        results: where the tables go (default: results/ for the full profile, else results/local/<profile>/).
        tensorboard: folder for curves of training and CEM, written afterwards; results do not depend on it.
    """

    common: tyro.conf.OmitArgPrefixes[Common]
    results: Path | None = None
    tensorboard: Path | None = None

    def run(self) -> None:
        """Do it."""
        from safeswitch import board
        from safeswitch.pipeline import prepare
        from safeswitch.publish import default_folder, publish
        from safeswitch.report import write_report
        from safeswitch.summary import announcement, summary

        if self.tensorboard:
            board.check_installed()
        started, runs = time.perf_counter(), self.common.runs()
        folder = (self.results or default_folder(self.common.profile)).absolute()
        log.print("\n".join(announcement(runs, folder)), markup=False)
        for run in runs:
            run.plan_for(folder)
        prepare(runs)
        for run in runs:
            publish(run, folder)
            if self.tensorboard:
                board.write_training(run, self.tensorboard)
                log.print(f"curves in [cyan]{board.write_searches(run, self.tensorboard)}[/]")
        write_report(folder)
        data, shown = summary(runs, folder, time.perf_counter() - started)
        answer(data, *shown)


@dataclass
class Report(Output):
    """Write report.html: one page without network that shows a folder of results, every threshold included.

    Attributes:
        results: folder with leaderboard.csv and tables/ (default: results/).
    """

    results: Path | None = None

    def run(self) -> None:
        """Do it."""
        from safeswitch.publish import default_folder
        from safeswitch.report import write_report

        self.set()
        path = write_report(self.results or default_folder("full"))
        answer({"report": path}, f"[cyan]{path}[/]: {path.stat().st_size / 1e6:.1f} MB")


@dataclass
class Demos:
    """Record the expert's demonstrations only, as Minari datasets."""

    common: tyro.conf.OmitArgPrefixes[Common]

    def run(self) -> None:
        """Do it."""
        folders = {run.task.dataset: run.store.folder(run.demonstrations.key) for run in self.common.runs()}
        answer(folders, *(f"{name}: MINARI_DATASETS_PATH={folder}" for name, folder in folders.items()))


@dataclass
class Train:
    """Train the learners only.

    Attributes:
        tensorboard: folder for curves of training, written afterwards; results do not depend on it.
    """

    common: tyro.conf.OmitArgPrefixes[Common]
    tensorboard: Path | None = None

    def run(self) -> None:
        """Do it."""
        from safeswitch import board
        from safeswitch.pipeline import train

        if self.tensorboard:
            board.check_installed()
        runs = self.common.runs()
        train(runs)
        folders = {job.label: run.store.folder(job.key) for run in runs for job in run.learners}
        if self.tensorboard:
            for run in runs:
                log.print(f"curves in [cyan]{board.write_training(run, self.tensorboard)}[/]")
        answer(folders, *(f"{name}: {folder}" for name, folder in folders.items()))


@dataclass
class Evaluate:
    """Score one learner and rule, the suite's or your own, in one cell."""

    common: tyro.conf.OmitArgPrefixes[Common]
    contestant: tyro.conf.OmitArgPrefixes[Contestant]

    def run(self) -> None:
        """Do it."""
        from safeswitch.evaluation import score_rows

        if self.contestant.learner and not self.common.task:
            raise ValueError("a learner is for one task: add --task, for example --task cart-pole")
        rows, shown = {}, []
        for run in self.common.runs():
            found = self.contestant.evaluate(run)
            title = f"{found.run.task.learner} with {found.method} in {found.cell} ({found.protocol})"
            table = Table("score", "value", "95 % interval", title=escape(title))
            for row in score_rows(found.scores):
                table.add_row(*row)
            rows[run.task.name] = found.scores
            shown.append(table)
        answer(rows, *shown)


@dataclass
class Gate:
    """Check a task's first gate: the expert takes over undisturbed episodes at every fifth step, and drives alone.

    Attributes:
        episodes: episode seeds per check, from the design split.
        every: steps between the handovers that are tried.
    """

    common: tyro.conf.OmitArgPrefixes[Common]
    episodes: int = 200
    every: int = 5

    def run(self) -> int:
        """Do it; 1 if a task is below the gate."""
        from safeswitch.evaluate import GATE, gate

        rows, passed = {}, True
        shown: list[Table | str] = []
        for run in self.common.runs():
            rows[run.task.name] = gate(run, self.episodes, self.every)
            table = Table("check", "trials", "success", "95 % interval", title=run.task.name)
            for row in rows[run.task.name]:
                interval = f"{row['lo']:.4f} to {row['hi']:.4f}"
                table.add_row(row["check"], f"{row['successes']} of {row['trials']}", f"{row['success']:.4f}", interval)
            handed = rows[run.task.name][0]
            verdict = "passed" if handed["success"] >= GATE else "not passed"
            shown += [table, f"{run.task.name}: {verdict} ({handed['success']:.4f}, at least {GATE} is needed)"]
            passed = passed and handed["success"] >= GATE
        answer(rows, *shown)
        return 0 if passed else 1


@dataclass
class ExpertReport:
    """Drive the rally car's expert: laps, avoidance against distance at handover, milliseconds, errors of its model.

    Attributes:
        task: rally-car-image or rally-car.
        laps: laps in one go, on each track at each speed.
        episodes: episodes with an obstacle, on each track at each speed.
        out: folder of the tables and the figure (default: results/local/expert/<task>).
    """

    output: tyro.conf.OmitArgPrefixes[Output] = field(default_factory=Output)
    task: str = "rally-car-image"
    laps: int = 50
    episodes: int = 100
    out: Path | None = None

    def run(self) -> None:
        """Do it."""
        from safeswitch.expert_report import report

        self.output.set()
        folder, shown = self.out or Path("results/local/expert") / self.task, []
        tables = report(self.task, folder, self.laps, self.episodes, log.print)
        for name, rows in tables.items():
            table = Table(*rows.columns, title=name)
            for row in rows.itertuples(index=False):
                table.add_row(*(f"{value:.3g}" if isinstance(value, float) else str(value) for value in row))
            shown.append(table)
        data = {name: rows.to_dict("records") for name, rows in tables.items()}
        answer({"folder": folder, **data}, *shown, f"tables and figure in [cyan]{folder}[/]")


@dataclass
class List:
    """List tasks with their cells, disturbances, learners, signals, methods and profiles."""

    output: tyro.conf.OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> None:
        """Do it."""
        self.output.set()
        names: dict[str, list[str]] = {}
        for task in suite.TASKS.values():
            names[f"cells of {task.name}"] = [str(cell).split("/", 1)[1] for cell in task.cells]
        for kind in registry.GROUPS:
            names[f"{kind}s"] = list(registry.names(kind))
        names["profiles"] = list(suite.PROFILES)
        table = Table("kind", "names", show_lines=True)
        for what, each in names.items():
            table.add_row(what, ", ".join(each))
        answer(names, table)


@dataclass
class Play:
    """Render one episode to a video file.

    Attributes:
        driver: learner, expert, or a method id such as cem@total.
        disturbance: disturbance of the cell (default: the paper's); none for the undisturbed task.
        severity: 1 to 5.
        seed: episode seed.
        out: file to write, .mp4 or .gif.
    """

    common: tyro.conf.OmitArgPrefixes[Common]
    driver: str = "cem@total"
    disturbance: str | None = None
    severity: int = 3
    protocol: str = "onset"
    seed: int = 0
    out: Path = Path("episode.mp4")

    def run(self) -> None:
        """Do it."""
        from safeswitch.evaluate import play

        if len(runs := self.common.runs()) != 1:
            raise ValueError("play needs one task: add --task, for example --task cart-pole")
        episode = play(runs[0], self.driver, self.disturbance, self.severity, self.protocol, self.seed, self.out)
        verdict = "success" if episode.success else "failure"
        handover = episode.handover if episode.handover < episode.horizon else "never"
        data = {"file": self.out, "success": episode.success, "onset": episode.onset}
        data |= {"handover": None if handover == "never" else handover, "steps": episode.length}
        answer(data, f"{self.out}: {verdict}, onset {episode.onset}, handover {handover}, {episode.length} steps")


@dataclass
class Doctor:
    """Check this machine: each thing that the suite needs, with its remedy."""

    output: tyro.conf.OmitArgPrefixes[Output] = field(default_factory=Output)

    def run(self) -> int:
        """Do it; 1 if something is missing."""
        from safeswitch.doctor import print_checks, run_checks

        self.output.set()
        checks = run_checks()
        failed = [check for check in checks if not check.ok]
        if self.output.json:
            answer([asdict(check) for check in checks])
        elif not self.output.quiet:
            print_checks(checks, console)
        elif failed:
            log.quiet = False
            print_checks(failed, log)
        return 1 if failed else 0


Command = (
    Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Demos, tyro.conf.subcommand("demos")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[submit_commands.Submit, tyro.conf.subcommand("submit")]
    | Annotated[submit_commands.Leaderboard, tyro.conf.subcommand("leaderboard")]
    | Annotated[submit_commands.Verify, tyro.conf.subcommand("verify")]
    | Annotated[commands.Score, tyro.conf.subcommand("score")]
    | Annotated[commands.Compare, tyro.conf.subcommand("compare")]
    | Annotated[commands.Reference, tyro.conf.subcommand("reference")]
    | Annotated[Gate, tyro.conf.subcommand("gate")]
    | Annotated[ExpertReport, tyro.conf.subcommand("expert-report")]
    | Annotated[List, tyro.conf.subcommand("list")]
    | Annotated[Play, tyro.conf.subcommand("play")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
)


def main(arguments: list[str] | None = None) -> int:
    """Entry point of the `safeswitch` command. Returns the exit code (see above)."""
    command = tyro.cli(Command, prog="safeswitch", description=__doc__, args=arguments)  # type: ignore[call-overload]
    try:
        with for_this_process_alone():
            return command.run() or 0
    except ValueError as error:
        return _stopped(str(error), 2)
    except (StageError, OSError) as error:
        if error.__cause__ is not None:  # a bug, or a method of somebody's: where it is
            traceback.print_exception(error.__cause__)
        return _stopped(str(error), 1)
    except KeyboardInterrupt:
        log.quiet = False
        log.print("interrupted: finished work is kept, the same command continues where it stopped")
        return 130


def _stopped(message: str, code: int) -> int:
    """Say why a command stopped, `--quiet` or not, and return its exit code."""
    log.quiet = False
    log.print("[bold red]error:[/]", escape(message))
    return code


if __name__ == "__main__":
    sys.exit(main())
