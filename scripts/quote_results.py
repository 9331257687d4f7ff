"""Keeps the numbers that the documentation quotes equal to the committed tables.

A quoted number is followed by an HTML comment, which no reader sees, that says where it stands::

    5.21<!--= leaderboard cart-pole/cart-mass-3 onset cem@total return_mean -->
    0.94<!--= signals cart-pole/cart-mass-3 epistemic frame_auroc -->
    0.20<!--= comparisons cart-pole/cart-mass-3 onset cem@total grid@total return_diff -->

the name of a CSV file in results/, the cell, the row, the column. The number keeps as many digits as it has. Between
`<!--rows leaderboard CELL PROTOCOL: METHOD METHOD ... -->` and `<!--/rows-->` stands a table of those methods.

Between `<!--signals CELL PROTOCOL COLUMN[/COLUMN]: RULE RULE ... -->` and `<!--/signals-->` stands a table of these
columns of leaderboard.csv for `RULE@signal`, a row per signal.

Rows whose threshold comes from other disturbances are quoted from left_out.csv alone.

Between `<!--disturbances TASK-->` and `<!--/disturbances-->` stands the table of a task's disturbances.

Usage: python scripts/quote_results.py [--write] [FILE ...]     (default: every page of docs/, and README.md)
Without --write it lists what differs; the exit code is then 1.
"""

from __future__ import annotations

import argparse
import difflib
import re
import sys
from functools import cache
from pathlib import Path

import pandas as pd

from safeswitch.scoring.leaderboard import read_csv
from safeswitch.scoring.metrics import OTHERS

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "results"
NUMBER = re.compile(r"(?P<number>[-+]?\d+(?:\.(?P<digits>\d+))?|–)(?P<quote><!--= (?P<where>[^>]*?) -->)")
ROWS = re.compile(
    r"(?P<open><!--rows (?P<table>\S+) (?P<cell>\S+) (?P<protocol>\S+): (?P<methods>[^>]*?) -->\n)"
    r".*?(?P<close><!--/rows-->)",
    re.DOTALL,
)
SIGNALS = re.compile(
    r"(?P<open><!--signals (?P<cell>\S+) (?P<protocol>\S+) (?P<columns>\S+): (?P<rules>[^>]*?) -->\n)"
    r".*?(?P<close><!--/signals-->)",
    re.DOTALL,
)
DISTURBANCES = re.compile(r"(?P<open><!--disturbances (?P<task>\S+)-->\n).*?(?P<close><!--/disturbances-->)", re.DOTALL)
KEYS = {
    "leaderboard": ("protocol", "method"),
    "paper_literal_leaderboard": ("protocol", "method"),
    "signals": ("signal",),
    "paper_literal_signals": ("signal",),
    "comparisons": ("protocol", "reference", "method"),
    "left_out": ("protocol", "method"),
    "sensitivity": ("protocol", "parameter", "value", "method"),
    "sightings": ("kind", "signal"),
}
"""What names a row of a table within a cell; a cell of left_out.csv is a whole task."""


@cache
def table(name: str) -> pd.DataFrame:
    """A table of results/, with the cell of each row as text."""
    if name not in KEYS:
        raise ValueError(f"no table {name!r} to quote; there are {', '.join(KEYS)}")
    frame = read_csv(RESULTS / f"{name}.csv")
    if name == "left_out":
        return frame.assign(cell=frame["task"])
    if "calibrated_on" in frame:
        frame = frame[frame["calibrated_on"] != OTHERS]
    severity = frame["severity"].map(lambda value: f"-{value}" if value else "")
    return frame.assign(cell=frame["task"] + "/" + frame["disturbance"] + severity)


def row(name: str, cell: str, *values: str) -> pd.Series:
    """The one row of a table that a quote means."""
    frame = table(name)
    chosen = frame[frame["cell"] == cell]
    for key, value in zip(KEYS[name], values, strict=True):
        chosen = chosen[chosen[key] == (float(value) if key == "value" else value)]
    if len(chosen) != 1:
        raise ValueError(f"{len(chosen)} rows of {name}.csv are {cell} {' '.join(values)}, expected one")
    return chosen.iloc[0]


def quoted(where: str) -> float:
    """The number that stands at `where`."""
    name, cell, *rest = where.split()
    *values, column = rest
    found = row(name, cell, *values)
    if column not in found:
        raise ValueError(f"{name}.csv has no column {column!r}")
    return float(found[column])


def unsigned_zero(shown: str) -> str:
    """`shown` without its minus where no digit is left of what it was: 0.00 and not -0.00."""
    return shown if shown.strip("-0.") else shown.lstrip("-")


def current(text: str) -> str:
    """`text` with every quoted number and table as it now stands in the tables."""

    def number(match: re.Match[str]) -> str:
        value, digits = quoted(match["where"]), len(match["digits"] or "")
        sign = "+" if match["number"].startswith("+") else ""
        shown = "–" if pd.isna(value) else f"{value:{sign}.{digits}f}"
        return unsigned_zero(shown) + match["quote"]

    def rows(match: re.Match[str]) -> str:
        found = {
            method: row(match["table"], match["cell"], match["protocol"], method) for method in match["methods"].split()
        }
        lines = left_out_lines(found) if match["table"] == "left_out" else leaderboard_lines(found)
        return match["open"] + "\n" + "\n".join(lines) + "\n\n" + match["close"]

    def disturbances(match: re.Match[str]) -> str:
        return match["open"] + "\n" + "\n".join(disturbance_table(match["task"])) + "\n\n" + match["close"]

    def signals(match: re.Match[str]) -> str:
        lines = signal_lines(match["cell"], match["protocol"], match["columns"].split("/"), match["rules"].split())
        return match["open"] + "\n" + "\n".join(lines) + "\n\n" + match["close"]

    return DISTURBANCES.sub(disturbances, SIGNALS.sub(signals, ROWS.sub(rows, NUMBER.sub(number, text))))


def signal_lines(cell: str, protocol: str, columns: list[str], rules: list[str]) -> list[str]:
    """Markdown table of columns of the leaderboard, signals by rules; blank where a method has no row."""
    frame = table("leaderboard")
    frame = frame[(frame["cell"] == cell) & (frame["protocol"] == protocol)]
    frame = frame.set_index("method")
    signals = dict.fromkeys(
        method.partition("@")[2] for method in frame.index if method.partition("@")[0] in rules and "@" in method
    )
    if not signals:
        raise ValueError(f"no method {' or '.join(rule + '@' for rule in rules)} in {cell} {protocol}")
    lines = ["| signal | " + " | ".join(f"`{rule}@`" for rule in rules) + " |", "| :-- |" + " --: |" * len(rules)]
    for signal in signals:
        shown = []
        for rule in rules:
            found = frame.loc[f"{rule}@{signal}"] if f"{rule}@{signal}" in frame.index else None
            values = ["" if found is None or pd.isna(found[name]) else f"{found[name]:.2f}" for name in columns]
            shown.append(" / ".join(values) if any(values) else "")
        lines.append(f"| `{signal}` | " + " | ".join(shown) + " |")
    return lines


def leaderboard_lines(found: dict[str, pd.Series]) -> list[str]:
    """Markdown table of rows of a leaderboard."""
    lines = ["| method | return | success | autonomy | skill |", "| :-- | --: | --: | --: | --: |"]
    for method, each in found.items():
        skill = "–" if pd.isna(each["contest_gap"]) else "no contest"
        if pd.notna(each["skill"]):
            skill = with_interval(each, "skill", "skill")
        shown = with_interval(each, "return_mean", "return")
        lines.append(f"| `{method}` | {shown} | {each['success']:.2f} | {each['autonomy']:.2f} | {skill} |")
    return lines


def left_out_lines(found: dict[str, pd.Series]) -> list[str]:
    """Markdown table of rows of left_out.csv."""
    lines = [
        "| method | return | success | autonomy | minus `cem@total` | minus `grid@total` | gap closed |",
        "| :-- | --: | --: | --: | --: | --: | --: |",
    ]
    for method, each in found.items():
        differences = (with_interval(each, f"minus_{rival}", f"minus_{rival}", "+") for rival in ("cem", "grid"))
        shares = (f"{each[name]:.2f}" for name in ("success", "armed_autonomy"))
        shown = [with_interval(each, "return_mean", "return"), *shares, *differences, f"{each['gap_closed']:.2f}"]
        lines.append(" | ".join([f"| `{method}`", *shown]) + " |")
    return lines


def with_interval(found: pd.Series, name: str, bounds: str, sign: str = "") -> str:
    """A score with its interval."""
    value, low, high = (f"{found[each]:{sign}.2f}" for each in (name, f"{bounds}_lo", f"{bounds}_hi"))
    return f"{value} [{low}, {high}]"


def disturbance_table(task: str) -> list[str]:
    """Markdown table of what a task offers: name, what severity 3 does, the values of all severities."""
    from safeswitch.tasks import visual  # noqa: F401  (registers the disturbances of images)
    from safeswitch.tasks.disturbances import DISTURBANCES as OFFERED

    lines = ["| disturbance | at severity 3 | severity 1 .. 5 |", "|---|---|---|"]
    for name, kind in OFFERED.items():
        if task in kind.tasks:
            benign = " (benign)" if kind.benign else ""
            levels = ", ".join(f"{level:g}" for level in kind.levels)
            lines.append(f"| `{name}`{benign} | {kind.describe(3)} | {levels} |")
    return lines


def pages() -> list[Path]:
    """Every page that may quote results."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def main() -> int:
    """Compare or rewrite."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", action="store_true", help="put the numbers of the tables into the pages")
    parser.add_argument("files", nargs="*", type=Path)
    options, stale = parser.parse_args(), 0
    for page in options.files or pages():
        text = page.read_text()
        new = current(text)
        if not options.write:
            changes = difflib.unified_diff(text.splitlines(), new.splitlines(), page.name, "the tables", "", "", 0, "")
            print(*changes, sep="\n", end="")
        stale += new != text
        if options.write and new != text:
            page.write_text(new)
    return 0 if options.write else int(stale > 0)


if __name__ == "__main__":
    sys.exit(main())
