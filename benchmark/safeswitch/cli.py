"""When should a learned controller hand control back to an expert? Run, score and compare switch rules."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from safeswitch import commands, registry, submit_commands, suite
from safeswitch.console import console
from safeswitch.options import Common, Contestant


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
        from safeswitch.publish import publish

        if self.tensorboard:
            board.check_installed()
        for run in self.common.runs():
            folder = publish(run, self.results)
            if self.tensorboard:
                board.write_training(run, self.tensorboard)
                console.print(f"curves in [cyan]{board.write_searches(run, self.tensorboard)}[/]")
            console.print(f"[bold]{run.task.name}[/]: leaderboard in [cyan]{folder / 'leaderboard.md'}[/]")


@dataclass
class Demos:
    """Record the expert's demonstrations only, as Minari datasets."""

    common: tyro.conf.OmitArgPrefixes[Common]

    def run(self) -> None:
        """Do it."""
        for run in self.common.runs():
            folder = run.store.folder(run.demonstrations.key)
            console.print(f"{run.task.dataset}: MINARI_DATASETS_PATH={folder}")


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

        if self.tensorboard:
            board.check_installed()
        for run in self.common.runs():
            if self.tensorboard:
                console.print(f"curves in [cyan]{board.write_training(run, self.tensorboard)}[/]")
            for job in run.learners:
                console.print(f"{job.label}: {run.store.folder(job.key)}")


@dataclass
class Evaluate:
    """Score one learner and rule, the suite's or your own, in one cell."""

    common: tyro.conf.OmitArgPrefixes[Common]
    contestant: tyro.conf.OmitArgPrefixes[Contestant]

    def run(self) -> None:
        """Do it."""
        if self.contestant.learner and not self.common.task:
            raise ValueError("a learner is for one task: add --task, for example --task cart-pole")
        for run in self.common.runs():
            found = self.contestant.evaluate(run)
            table = Table("score", "value", title=f"{found.run.task.learner} with {found.method} in {found.cell}")
            for name, value in found.scores.items():
                table.add_row(str(name), f"{value:.4g}" if isinstance(value, float) else str(value))
            console.print(table)


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

    def run(self) -> None:
        """Do it."""
        from safeswitch.evaluate import gate

        for run in self.common.runs():
            table = Table("check", "trials", "success", "95 % interval", title=run.task.name)
            for row in gate(run, self.episodes, self.every):
                interval = f"{row['lo']:.4f} to {row['hi']:.4f}"
                table.add_row(row["check"], f"{row['successes']} of {row['trials']}", f"{row['success']:.4f}", interval)
            console.print(table)


@dataclass
class ExpertReport:
    """Drive the rally car's expert: laps, avoidance against distance at handover, milliseconds, errors of its model.

    Attributes:
        task: rally-car-image or rally-car.
        laps: laps in one go, on each track at each speed.
        episodes: episodes with an obstacle, on each track at each speed.
        out: folder of the tables and the figure (default: results/local/expert/<task>).
    """

    task: str = "rally-car-image"
    laps: int = 50
    episodes: int = 100
    out: Path | None = None

    def run(self) -> None:
        """Do it."""
        from safeswitch.expert_report import report

        folder = self.out or Path("results/local/expert") / self.task
        for name, rows in report(self.task, folder, self.laps, self.episodes, console.print).items():
            table = Table(*rows.columns, title=name)
            for row in rows.itertuples(index=False):
                table.add_row(*(f"{value:.3g}" if isinstance(value, float) else str(value) for value in row))
            console.print(table)
        console.print(f"tables and figure in [cyan]{folder}[/]")


@dataclass
class List:
    """List tasks with their cells, disturbances, learners, signals, methods and profiles."""

    def run(self) -> None:
        """Do it."""
        table = Table("kind", "names", show_lines=True)
        for task in suite.TASKS.values():
            table.add_row(f"cells of {task.name}", ", ".join(str(cell).split("/", 1)[1] for cell in task.cells))
        for kind in registry.GROUPS:
            table.add_row(f"{kind}s", ", ".join(registry.names(kind)))
        table.add_row("profiles", ", ".join(suite.PROFILES))
        console.print(table)


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
        console.print(f"{self.out}: {verdict}, onset {episode.onset}, handover {handover}, {episode.length} steps")


@dataclass
class Doctor:
    """Check this machine: each thing that the suite needs, with its remedy."""

    def run(self) -> int:
        """Do it; 1 if something is missing."""
        from safeswitch.doctor import main as doctor

        return doctor()


Command = (
    Annotated[Bench, tyro.conf.subcommand("bench")]
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
    """Entry point of the `safeswitch` command. Returns the exit code: 0 done, 1 failed check, 2 bad input."""
    command = tyro.cli(Command, prog="safeswitch", description=__doc__, args=arguments)  # type: ignore[call-overload]
    try:
        return command.run() or 0
    except ValueError as error:
        console.quiet = False
        console.print("[bold red]error:[/]", escape(str(error)))
        return 2
    except KeyboardInterrupt:
        console.print("interrupted; run the same command again to continue")
        return 130


if __name__ == "__main__":
    sys.exit(main())
