"""The command line: bench, demos, train, evaluate, submit, leaderboard, verify, gate, expert-report and others."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from safeswitch import registry, suite
from safeswitch.console import console

if TYPE_CHECKING:
    from safeswitch.evaluation import Evaluation
    from safeswitch.pipeline import Run


@dataclass
class Common:
    """Options that every command on runs shares.

    Attributes:
        profile: how much is run: smoke, standard or full.
        task: one task only; all tasks where it is left out.
        jobs: processes at a time (default: the number of cores); results do not depend on it.
        store: folder of finished work (default: .safeswitch/store in the checkout, or $SAFESWITCH_STORE).
        quiet: print errors only.
    """

    profile: str = "standard"
    task: str | None = None
    jobs: int | None = None
    store: Path | None = None
    quiet: bool = False

    def runs(self) -> list:
        """One run per task."""
        from safeswitch.pipeline import Run
        from safeswitch.store import Store

        console.quiet = self.quiet
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
class Submit:
    """Score one learner and rule, and write a submission to the leaderboard: one JSON file. See docs/submit.md.

    Attributes:
        name: of the entry, as the table shows it.
        authors: who submits it.
        url: where the code of learner and rule is.
        description: one or two sentences.
        results: folder of the leaderboard; the file goes into its folder submissions (default: results/).
    """

    common: tyro.conf.OmitArgPrefixes[Common]
    contestant: tyro.conf.OmitArgPrefixes[Contestant]
    name: str
    authors: str
    url: str = ""
    description: str = ""
    results: Path | None = None

    def run(self) -> None:
        """Do it."""
        from safeswitch import submissions
        from safeswitch.publish import default_folder

        if not self.common.task:
            raise ValueError("a submission is about one task: add --task, for example --task cart-pole")
        (run,) = self.common.runs()
        folder = (self.results or default_folder("full")) / "submissions"
        about = (self.name, self.authors, self.url, self.description)
        found = self.contestant.evaluate(run)
        path = submissions.write(found, folder, *about)
        score = f"return {found.scores['return_mean']:.3f}, success {found.scores['success']:.3f}"
        console.print(f"{self.name} in {found.cell} ({found.protocol}): {score}; submission in [cyan]{path}[/]")


@dataclass
class Leaderboard:
    """Check every submission and write the table of those that hold beside the leaderboard. Exit code 1: some do not.

    Attributes:
        results: folder of the leaderboard (default: results/).
        minimum_episodes: a submission with fewer test episodes a learner is refused.
    """

    results: Path | None = None
    minimum_episodes: int = 40

    def run(self) -> int:
        """Do it; 1 if a submission was refused."""
        from safeswitch.publish import default_folder
        from safeswitch.verification import merge

        folder = self.results or default_folder("full")
        table, refused = merge(folder, self.minimum_episodes)
        for name, reason in refused.items():
            console.print(f"[bold red]refused[/] {escape(name)}: {escape(reason)}")
        console.print(f"{len(table)} merged, {len(refused)} refused; table in [cyan]{folder / 'submissions.md'}[/]")
        return 1 if refused else 0


@dataclass
class Verify:
    """Run a submission again on kept-back episodes, and tell whether it agrees (maintainers). Exit code 1: it does not.

    The code of learner and rule must be importable. It is somebody else's: run it in a container without a network.

    Attributes:
        submission: the JSON file.
        secret: decides the kept-back episodes (default: $SAFESWITCH_SECRET).
        jobs: processes at a time (default: the number of cores).
        store: folder of finished work.
    """

    submission: tyro.conf.Positional[Path]
    secret: str | None = None
    jobs: int | None = None
    store: Path | None = None

    def run(self) -> int:
        """Do it; 1 if the rerun does not agree."""
        from safeswitch.submissions import read
        from safeswitch.verification import commitment, verify

        secret = self.secret or os.environ.get("SAFESWITCH_SECRET", "")
        commitment(secret)  # refuses one that is too short before anything is run
        if not self.submission.is_file():
            raise ValueError(f"there is no submission {self.submission}")
        submission = read(self.submission)
        content = submission.content
        (run,) = Common(content["profile"]["name"], content["cell"]["task"], self.jobs, self.store).runs()
        record = verify(run, submission, secret)
        table = Table("score", "reported", "on kept-back episodes", "intervals overlap", title=content["name"])
        for name, agrees in record["agreement"].items():
            prefix = name.removesuffix("_mean")
            shown = [
                f"{scores[name]:.3f} [{scores[f'{prefix}_lo']:.3f}, {scores[f'{prefix}_hi']:.3f}]"
                for scores in (submission.scores, record["scores"])
            ]
            table.add_row(name, *shown, "yes" if agrees else "NO")
        console.print(table)
        console.print("verified" if record["agrees"] else "[bold red]not confirmed[/]")
        return 0 if record["agrees"] else 1


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
    | Annotated[Submit, tyro.conf.subcommand("submit")]
    | Annotated[Leaderboard, tyro.conf.subcommand("leaderboard")]
    | Annotated[Verify, tyro.conf.subcommand("verify")]
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
