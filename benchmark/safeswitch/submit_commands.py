"""Commands on submissions: submit, leaderboard, verify."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.markup import escape
from rich.table import Table

from safeswitch.console import answer
from safeswitch.options import Common, Contestant, Output


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
        text = f"{self.name} in {found.cell} ({found.protocol}): {score}; submission in [cyan]{path}[/]"
        answer({"submission": path, "scores": found.scores}, text)


@dataclass
class Leaderboard(Output):
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

        self.set()
        folder = self.results or default_folder("full")
        table, refused = merge(folder, self.minimum_episodes)
        shown = [f"[bold red]refused[/] {escape(name)}: {escape(reason)}" for name, reason in refused.items()]
        shown.append(f"{len(table)} merged, {len(refused)} refused; table in [cyan]{folder / 'submissions.md'}[/]")
        answer({"merged": table["file"].tolist(), "refused": refused}, *shown)
        return 1 if refused else 0


@dataclass(kw_only=True)
class Verify(Output):
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
        (run,) = Common(
            json=self.json,
            quiet=self.quiet,
            profile=content["profile"]["name"],
            task=content["cell"]["task"],
            jobs=self.jobs,
            store=self.store,
        ).runs()
        record = verify(run, submission, secret)
        table = Table("score", "reported", "on kept-back episodes", "intervals overlap", title=content["name"])
        for name, agrees in record["agreement"].items():
            prefix = name.removesuffix("_mean")
            shown = [
                f"{scores[name]:.3f} [{scores[f'{prefix}_lo']:.3f}, {scores[f'{prefix}_hi']:.3f}]"
                for scores in (submission.scores, record["scores"])
            ]
            table.add_row(name, *shown, "yes" if agrees else "NO")
        answer(record, table, "verified" if record["agrees"] else "[bold red]not confirmed[/]")
        return 0 if record["agrees"] else 1
