"""Commands on published results and reference learners: score, compare, reference."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro
from rich.markup import escape
from rich.table import Column, Table

from safeswitch import suite
from safeswitch.console import console
from safeswitch.files import jsonable

SHOWN = 20
"""Differences that are printed one by one; `--json` has them all."""
SCORES = ("return", "success", "autonomy", "false_alarms", "skill")


@dataclass
class Score:
    """Score a latched rule on published handover tables: exact, in seconds, without a simulator.

    Attributes:
        tables: folder of one task's tables (results/tables/cart-pole), or of several tasks (results/tables).
        rule: a ready rule, package.module:factory.
        method: or a method, such as cem@total, which is calibrated on the calibrate episodes first.
        json: print every column as JSON.
    """

    tables: Path
    rule: str | None = None
    method: str | None = None
    json: bool = False

    def run(self) -> None:
        """Do it."""
        from safeswitch.score import find_tables, records, score_method, score_rule

        if (self.rule is None) == (self.method is None):
            raise ValueError("score needs --rule package.module:factory or --method id, and not both")
        found = find_tables(self.tables)
        scored = [score_rule(each, self.rule) if self.rule else score_method(each, self.method or "") for each in found]
        rows, left_out = [row for each in scored for row in records(each.table)], sum((s.left_out for s in scored), [])
        if self.json:
            _print_json({"scores": rows, "left_out": left_out})
            return
        for task in dict.fromkeys(row["task"] for row in rows):
            console.print(self._table(task, [row for row in rows if row["task"] == task]))
        for reason in left_out:
            console.print("[yellow]left out:[/]", escape(reason))

    def _table(self, task: str, rows: list[dict]) -> Table:
        """One line a cell and protocol; scores that apply nowhere have no column."""
        names = [name for name in SCORES if any(_applies(row, name) for row in rows)]
        columns = [Column(name, no_wrap=True) for name in ("cell", *names)]
        table = Table(*columns, title=escape(f"{task}: {self.rule or self.method}"), caption="with 95 % intervals")
        for row in rows:
            cell = row["disturbance"] + (f"-{row['severity']}" if row["severity"] else "")
            table.add_row(f"{cell}\n{row['protocol']}, n={row['episodes']}", *(_interval(row, name) for name in names))
        return table


@dataclass
class Compare:
    """Compare two result folders: the same bytes, intervals that overlap, or differences. Exit code 1 if they differ.

    Attributes:
        a: a result folder, for example results/local/full.
        b: another one, for example the committed results/.
        json: print everything as JSON.
    """

    a: tyro.conf.Positional[Path]
    b: tyro.conf.Positional[Path]
    json: bool = False

    def run(self) -> int:
        """Do it; 1 if they differ."""
        from safeswitch.compare import DIFFERS, compare

        tables = compare(self.a, self.b)
        differ = any(table.verdict == DIFFERS for table in tables)
        if self.json:
            _print_json({"agree": not differ, "tables": [asdict(each) | {"verdict": each.verdict} for each in tables]})
            return int(differ)
        headings = ("table", "verdict", "same", "overlap", "differ", "one side")
        summary = Table(*(Column(name, no_wrap=True) for name in headings))
        for table in tables:
            verdict = "same bytes" if table.identical else table.verdict
            counts = (str(each) for each in (*table.counts.values(), len(table.only_a) + len(table.only_b)))
            summary.add_row(table.name.removesuffix(".csv"), verdict, *counts)
        console.print(summary)
        if tasks := sorted({task for table in tables for task in table.tasks}):
            console.print(f"not compared, because only one folder ran it: {', '.join(tasks)}")
        self._print_differences(tables)
        return int(differ)

    def _print_differences(self, tables: list) -> None:
        found = [(table.name, each) for table in tables for each in table.differences]
        if not found:
            return
        shown = Table("table", "row", "score", "A", "B", title=f"the first {min(SHOWN, len(found))} of {len(found)}")
        for name, each in found[:SHOWN]:
            ends = (f"{low:.4g} to {high:.4g}" for low, high in (each.a, each.b))
            shown.add_row(name, escape(" ".join(filter(None, each.row))), each.score, *ends)
        console.print(shown)


@dataclass
class Reference:
    """Make the reference weights of a task, shipped with the package, from the suite's own run: learner seed 0.

    Attributes:
        task: the task.
        profile: whose demonstrations and training are used.
        jobs: processes at a time (default: the number of cores).
        store: folder of finished work.
        out: where to write (default: in the package that registers the task's learner).
    """

    task: str
    profile: str = "standard"
    jobs: int | None = None
    store: Path | None = None
    out: Path | None = None

    def run(self) -> None:
        """Do it."""
        from joblib import cpu_count

        from safeswitch.pipeline import Run
        from safeswitch.reference import make_reference
        from safeswitch.store import Store

        run = Run(suite.task(self.task), suite.profile(self.profile), Store(self.store), self.jobs or cpu_count())
        folder, manifest = make_reference(run, self.out)
        console.print(f"{folder}: {manifest['bytes'] / 1e6:.2f} MB, commit {manifest['commit']}")


def _applies(row: dict, name: str) -> bool:
    value = row["return_mean" if name == "return" else name]
    return bool(value == value)  # not NaN


def _interval(row: dict, name: str) -> str:
    """A score above its interval; nothing where it does not apply."""
    if not _applies(row, name):
        return ""
    value = row["return_mean" if name == "return" else name]
    return f"{value:.3f}\n{row[f'{name}_lo']:.2f} to {row[f'{name}_hi']:.2f}"


def _print_json(value: object) -> None:
    """Plain JSON on standard output, even under --quiet."""
    print(json.dumps(jsonable(value, "output", nan_as_null=True), indent=2))
