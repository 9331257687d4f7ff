"""What `bench` says before and after: how long it will take, what came out, and where the files are."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.table import Table

from safeswitch import durations, registry
from safeswitch.console import duration
from safeswitch.scoring.leaderboard import read_csv
from safeswitch.scoring.markdown import PAPER_METHOD, standing
from safeswitch.scoring.metrics import OTHERS, REFERENCES
from safeswitch.suite import Task

if TYPE_CHECKING:
    import pandas as pd

    from safeswitch.pipeline import Run

FILES = {
    "leaderboard.md": "every method in every cell, to read",
    "leaderboard.csv": "the same with every score and interval",
    "signals.csv": "how well each signal tells a disturbance",
    "sightings.csv": "how far ahead each signal sees what stands in the way",
    "left_out.csv": "thresholds learned on other disturbances",
    "comparisons.csv": "paired comparisons of methods",
    "cem_seeds.csv": "CEM's threshold over its seeds",
    "sensitivity.csv": "what thresholds hang on: budget, episodes, K",
    "failures.csv": "failures, crashes and failures of the solver",
    "latency.csv": "time of a decision of every method",
    "manifest.json": "commit, versions, seeds, times",
    "report.html": "the tables to explore, in a browser",
    "figures": "figures and a film of one episode, per task",
    "tables": "handover tables, to score other rules",
}
"""What a results folder may hold, in the order in which it is worth looking at."""


def announcement(runs: Sequence[Run], folder: Path) -> list[str]:
    """Lines that say what a benchmark is going to do, roughly how long it takes, and where results go."""
    first = runs[0]
    each = {run.task.name: durations.stages(run.task.name, run.profile.name, folder) for run in runs}
    times = {task: durations.total(found, first.workers) for task, found in each.items()}
    known = {task: seconds for task, seconds in times.items() if seconds}
    parts = [f"{task} {duration(seconds)}" for task, seconds in known.items()]
    guess = (
        f"roughly {duration(durations.together([*each.values()], first.workers))} from scratch"
        if known
        else "unknown, nothing like it was run yet"
    )
    if len(parts) > 1:
        guess += f" ({', '.join(parts)})"
    if known and len(known) < len(times):
        guess += f", and an unknown time for {', '.join(task for task in times if task not in known)}"
    if known:
        guess += ", on an idle machine"
    workers = f"{first.workers} worker{'s' if first.workers != 1 else ''}"
    return [
        f"SafeSwitch, profile {first.profile.name}: {', '.join(times)}, on {workers}",
        f"time:    {guess}",
        f"results: {folder}",
        f"store:   {first.store.root} (finished work, which is not done twice: Ctrl-C and run again to continue)",
    ]


def headline(task: Task, table: pd.DataFrame) -> list[dict[str, Any]]:
    """The paper's cell under each protocol: references, the paper's rule, the best rule and the bound of hindsight."""
    cell, rows = task.paper_cell, []
    table = table[(table["task"] == task.name) & (table["disturbance"] == cell.disturbance)]
    if "calibrated_on" in table:
        table = table[table["calibrated_on"] != OTHERS]
    makers = {name: registry.make_method(name) for name in table["method"].unique()}
    privileged = [name for name, maker in makers.items() if "privileged" in maker.needs]
    give_back = [name for name, maker in makers.items() if not maker.latched]
    for protocol, part in table[table["severity"] == cell.severity].groupby("protocol"):
        part = part.sort_values(["return_mean", "method"], ascending=[False, True]).set_index("method")
        rules = [name for name in part.index if standing(name, privileged, give_back) == "rule"]
        shown = {**dict.fromkeys(REFERENCES, "reference"), PAPER_METHOD: "paper"}
        if rules:
            shown[rules[0]] = "paper, best rule" if rules[0] == PAPER_METHOD else "best rule"
        shown["oracle-hindsight"] = "bound"
        scores = ["return_mean", "return_lo", "return_hi", "success", "autonomy", "episodes"]
        rows += [
            {"task": task.name, "cell": str(cell), "protocol": protocol, "method": name, "role": role}
            | part.loc[name, scores].to_dict()
            for name, role in shown.items()
            if name in part.index
        ]
    return rows


def headline_table(rows: Sequence[dict[str, Any]]) -> Table:
    """The same as a table for people, narrow enough for 80 columns."""
    title = "The paper's cell of each task, armed at onset and at start"
    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left", title_style="bold")
    table.add_column("method", no_wrap=True)
    table.add_column("")
    for heading in ("return", "success", "autonomy"):
        table.add_column(heading, justify="right", no_wrap=True)
    for (cell, protocol, episodes), group in groupby(rows, key=itemgetter("cell", "protocol", "episodes")):
        if table.rows:
            table.add_section()
        table.add_row(f"{cell}, {protocol}", f"n = {episodes:.0f}", style="bold")
        for row in group:
            numbers = (f"{row['return_mean']:.2f}", f"{row['success']:.2f}", f"{row['autonomy']:.2f}")
            table.add_row(f"  {row['method']}", row["role"], *numbers, style="green" if "best" in row["role"] else "")
    return table


def files(folder: Path) -> dict[str, str]:
    """Path below `folder` -> what it is, of all that is there."""
    return {name: about for name, about in FILES.items() if (folder / name).exists()}


def summary(runs: Sequence[Run], folder: Path, seconds: float) -> tuple[dict[str, Any], list[Any]]:
    """What came out: as data for `--json`, and what to print for people."""
    table = read_csv(folder / "leaderboard.csv")
    rows = [row for run in runs for row in headline(run.task, table)]
    found = files(folder)
    data = {
        "profile": runs[0].profile.name,
        "results": str(folder),
        "files": {name: str(folder / name) for name in found},
        "seconds": round(seconds, 1),
        "stage_seconds": {run.task.name: {name: round(wall, 1) for name, wall in run.seconds.items()} for run in runs},
        "headline": rows,
    }
    width = max(map(len, found))
    lines = [f"  {name:<{width}}  {about}" for name, about in found.items()]
    first = folder / next(name for name in ("report.html", *FILES) if name in found)
    return data, [headline_table(rows), f"Done in {duration(seconds)}. In {folder}:", *lines, f"Open {first}"]
