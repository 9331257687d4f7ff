"""leaderboard.md: the headline on top, then one table per cell and protocol, bounds and controls apart."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from safeswitch.scoring.leaderboard import write_text
from safeswitch.scoring.metrics import MIN_CONTEST, OTHER_PHIS, OTHERS, PHI, REFERENCES, signal_of
from safeswitch.suite import SHARES

PAPER_CELLS: Mapping[str, tuple[str, int]] = {"cart-pole": ("cart-mass", 3)}
"""Task -> (disturbance, severity) of the paper, when the caller does not say."""
PAPER_METHOD = "cem@total"
UPPER_BOUNDS = ("oracle-", "best@")
BLIND_CONTROLS = ("shuffled", "random", "periodic")
MATCHED_SHARES = tuple(f"{rule}-{share}" for share in SHARES for rule in ("share", "random"))
BLANK = "–"

Row = Mapping[str, Any]


def standing(method: str, privileged: Collection[str] = (), give_back: Collection[str] = ()) -> str:
    """Where a method is ranked: "bound", "control", "share", "reference", "give-back" or "rule"."""
    rule = method.partition("@")[0]
    if method.startswith(UPPER_BOUNDS) or method in privileged:
        return "bound"
    if rule in MATCHED_SHARES:
        return "share"
    if rule in BLIND_CONTROLS:
        return "control"
    if method in REFERENCES:
        return "reference"
    return "give-back" if method in give_back else "rule"


def write_markdown(
    table: pd.DataFrame,
    path: Path,
    paper_cells: Mapping[str, tuple[str, int]] | None = None,
    privileged: Collection[str] = (),
    give_back: Collection[str] = (),
    notes: Sequence[str] = (),
    needs: Mapping[str, str] | None = None,
    first: Mapping[str, Sequence[str]] | None = None,
) -> Path:
    """Write the leaderboard for readers.

    Args:
        table: what `leaderboard` returns (of one or several tasks).
        path: the file.
        paper_cells: task -> (disturbance, severity) shown in the headline; default `PAPER_CELLS`.
        privileged: further methods that use what a deployed rule cannot know.
        give_back: methods that may return control to the learner; they are ranked apart.
        notes: lines put under the title, for example the profile and the commit.
        needs: method -> what it needs, as it stands in the tables.
        first: task -> lines put before its tables, for example the headline that leaves a disturbance out.
    """
    chosen = PAPER_CELLS if paper_cells is None else paper_cells
    if "calibrated_on" in table:  # the rows that leave a disturbance out are summed up in `first`
        table = table[table["calibrated_on"] != OTHERS]
    table = table.assign(
        standing=[standing(name, privileged, give_back) for name in table["method"]],
        needs=[(needs or {}).get(name, BLANK) for name in table["method"]],
    )
    lines = ["# SafeSwitch leaderboard", "", *(f"{note}  " for note in notes), ""]
    for task, rows in table.groupby("task", sort=True):
        paper = chosen.get(str(task))
        lines += [f"## {task}", "", *(first or {}).get(str(task), ()), *_headline(rows, paper), *_cells(rows, paper)]
    lines += _legend()
    write_text(path, "\n".join(lines).rstrip() + "\n")
    return path


def _headline(rows: pd.DataFrame, paper: tuple[str, int] | None) -> list[str]:
    """The paper's cell under each protocol: the paper's rule, the best rules, and what they are measured by."""
    if paper is None:
        return []
    cell = rows[(rows["disturbance"] == paper[0]) & (rows["severity"] == paper[1])]
    lines = [f"### Headline: the paper's cell, {paper[0]} severity {paper[1]}", ""]
    if cell.empty:
        return [*lines, "Not part of this run.", ""]
    for protocol, part in cell.groupby("protocol", sort=True):
        lines += [f"**Protocol `{protocol}`** ({_protocol(str(protocol))}, {_counts(part)})", ""]
        lines += [*_headline_table(part), "", _contest(part), ""]
    return lines


def _headline_table(part: pd.DataFrame) -> list[str]:
    ranked = _ranked(part)
    rules = ranked[ranked["standing"] == "rule"]
    shown = [("paper", row) for row in _records(rules[rules["method"] == PAPER_METHOD])]
    names = ("best rule", "second", "third")
    shown += [(name, row) for name, row in zip(names, _records(rules.head(len(names))), strict=False)]
    references = ranked[ranked["standing"] == "reference"]
    shown += [(f"reference{' (R0)' if i == 0 else ''}", row) for i, row in enumerate(_records(references))]
    bounds = ranked[ranked["method"].isin([f"best@{signal_of(PAPER_METHOD)}", "oracle-hindsight"])]
    shown += [("*bound*", row) for row in _records(bounds)]
    header = ["", "method", f"return, phi = {PHI:g}", *(f"phi = {phi:g}" for phi in OTHER_PHIS), "skill", "success"]
    body = [
        [
            label,
            _name(row),
            interval(row, "return_mean", "return"),
            *(number(row[f"return_phi{phi:g}"]) for phi in OTHER_PHIS),
            _skill(row),
            interval(row, "success", "success"),
            number(row["autonomy"]),
        ]
        for label, row in shown
    ]
    return markdown_table([*header, "autonomy"], body)


def _contest(part: pd.DataFrame) -> str:
    """What the cell has to give: R0, and the hindsight best of each signal."""
    references = _ranked(part[part["method"].isin(REFERENCES)])
    best = _ranked(part[part["method"].str.startswith("best@")])
    if len(references) < len(REFERENCES) or best.empty:
        return "Skill needs `learner`, `expert`, `timer` and `best@` of the signal; they are not all part of this run."
    zero = references.iloc[0]
    entries = [
        f"{signal_of(row['method'])} {row['return_mean'] - zero['return_mean']:+.2f}"
        + ("" if row["return_mean"] - zero["return_mean"] >= MIN_CONTEST else " (no contest)")
        for row in _records(best)
    ]
    return f"R0 is `{zero['method']}`, {zero['return_mean']:.2f}; hindsight best of each signal above it: " + (
        ", ".join(entries) + "."
    )


def _cells(rows: pd.DataFrame, paper: tuple[str, int] | None) -> list[str]:
    """A section per cell, the paper's first and open, the others folded."""
    keys = sorted({(str(d), int(s)) for d, s in zip(rows["disturbance"], rows["severity"], strict=True)})
    keys.sort(key=lambda key: (key != paper, key[0].partition("@")[0] != "none"))
    lines: list[str] = []
    for disturbance, severity in keys:
        cell = rows[(rows["disturbance"] == disturbance) & (rows["severity"] == severity)]
        title = disturbance if disturbance.partition("@")[0] == "none" else f"{disturbance}, severity {severity}"
        folded = (disturbance, severity) != paper
        lines += [f"<details><summary><b>{title}</b></summary>", ""] if folded else [f"### {title}", ""]
        for protocol, part in cell.groupby("protocol", sort=True):
            lines += [f"#### {title}, protocol `{protocol}` ({_counts(part)})", "", *_cell_tables(part)]
        lines += ["</details>", ""] if folded else []
    return lines


def _cell_tables(part: pd.DataFrame) -> list[str]:
    ranked = _ranked(part)
    competing = ranked[ranked["standing"].isin(["rule", "reference"])]
    lines = [*markdown_table(_HEADER, map(_cell_row, _records(competing))), ""]
    apart = {
        "give-back": "Rules that may give control back, ranked apart:",
        "bound": "*Bounds: they use hindsight or privileged knowledge and do not compete.*",
        "share": "At a matched share of expert steps (5, 10, 20, 40 % on calibrate episodes); `random-` is blind:",
        "control": "*Blind controls: a rule that does not beat them has learned nothing from its signal.*",
    }
    for standing_name, caption in apart.items():
        group = ranked[ranked["standing"] == standing_name]
        if not group.empty:
            lines += [caption, "", *markdown_table(_HEADER, map(_cell_row, _records(group))), ""]
    return lines


_HEADER = [
    "method", "needs", "return", "skill", "success", "autonomy", "recovery", "harm", "timely", "false alarms",
    "tuning episodes",
]  # fmt: skip


def _cell_row(row: Row) -> list[str]:
    return [
        _name(row),
        str(row["needs"]),
        interval(row, "return_mean", "return"),
        _skill(row, bounds=True),
        interval(row, "success", "success"),
        *(number(row[name]) for name in ("autonomy", "recovery", "harm", "timely", "false_alarms")),
        number(row["tuning_episodes"], 0),
    ]


def _ranked(part: pd.DataFrame) -> pd.DataFrame:
    """By return, highest first; equal returns in alphabetical order."""
    return part.sort_values(["return_mean", "method"], ascending=[False, True], kind="stable")


def _records(frame: pd.DataFrame) -> list[Row]:
    return frame.to_dict("records")


def _name(row: Row) -> str:
    name = f"`{row['method']}`"
    calibrated_on = row.get("calibrated_on")
    if isinstance(calibrated_on, str) and calibrated_on:
        name += f" (from {calibrated_on})"
    marked = {"reference": f"*{name}*", "bound": f"*{name}* †", "control": f"*{name}* ‡"}
    return marked.get(row["standing"], name)


def _skill(row: Row, bounds: bool = False) -> str:
    if pd.isna(row["contest_gap"]):
        return BLANK
    if pd.isna(row["skill"]):
        return "no contest"
    return interval(row, "skill", "skill") if bounds else number(row["skill"])


def interval(row: Row, estimate: str, bounds: str) -> str:
    """Estimate with its bounds, for readers."""
    if pd.isna(row[estimate]):
        return BLANK
    return f"{number(row[estimate])} [{number(row[f'{bounds}_lo'])}, {number(row[f'{bounds}_hi'])}]"


def number(value: Any, digits: int = 2) -> str:
    """A number for readers; blank for NaN, and no minus before zero."""
    if pd.isna(value):
        return BLANK
    text = f"{value:.{digits}f}"
    return text[1:] if float(text) == 0 and text.startswith("-") else text


def _counts(part: pd.DataFrame) -> str:
    learners, episodes = int(part["learner_seeds"].max()), int(part["episodes"].max())
    return f"{learners} learner{'s' if learners != 1 else ''}, {episodes} episodes"


def _protocol(name: str) -> str:
    return {"onset": "armed at the onset, as in the paper", "start": "armed from step 0, as deployed"}.get(name, name)


def markdown_table(header: Sequence[str], body: Iterable[Sequence[str]]) -> list[str]:
    """Markdown table: words flush left, numbers flush right."""
    words = ("", "method", "needs")
    rule = [":--" if name in words else "--:" for name in header]
    return [f"| {' | '.join(cells)} |" for cells in (header, rule, *body)]


def _legend() -> list[str]:
    return [
        "## How to read this",
        "",
        "* Brackets hold 95 % intervals: bootstrap over learners x episode seeds, twins kept together; success within "
        "one learner: Wilson.",
        f"* Return: learner-driven share of the episode from the arming step on, plus {PHI:g} on success. Skill: 0 is "
        "the best of learner, expert and timer, 1 is the best constant threshold on the same signal in hindsight; "
        f"`no contest` where these two are less than {MIN_CONTEST:g} apart.",
        "* *Slanted*: references, bounds (†: hindsight or privileged) and blind controls (‡).",
        "* Thresholds are calibrated for the headline's return; the columns of other phi score the same episodes.",
        "* Needs: what calibration or decision requires beyond the learner and undisturbed episodes. F: episodes that "
        "fail; R: episodes with disturbances; Q: the expert is asked at every step; P: privileged knowledge.",
        f"* {BLANK}: the score does not apply (for example false alarms without undisturbed episodes).",
        "* Every score is defined in `docs/scores.md`; `leaderboard.csv` has all columns.",
    ]
