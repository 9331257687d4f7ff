"""Do two result folders agree? To check one's own run against the committed one.

Each table of results is compared row by row: *same* (every number as it is written), *overlap* (the 95 % intervals of
every score that has one overlap, and rows without intervals agree in their words), or *differs* (where, and which).
Rows that only one folder has are listed; a task that only one folder ran is not held against either.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from safeswitch.scoring.leaderboard import read_csv

KEY = [
    "task", "disturbance", "severity", "protocol", "method", "signal", "reference", "learner", "calibrated_on",
    "parameter", "value",
]  # fmt: skip
"""Columns that say which row it is, those that a table has."""
TABLES = (
    "leaderboard.csv", "left_out.csv", "signals.csv", "comparisons.csv", "paper_literal_leaderboard.csv",
    "paper_literal_signals.csv", "cem_seeds.csv", "sensitivity.csv", "failures.csv",
)  # fmt: skip
SAME, OVERLAP, DIFFERS = "same", "overlap", "differs"


@dataclass(frozen=True)
class Difference:
    """Intervals of one score that do not overlap.

    Attributes:
        row: the key's values.
        score: name of the score.
        a: its interval in A.
        b: its interval in B.
    """

    row: tuple[str, ...]
    score: str
    a: tuple[float, float]
    b: tuple[float, float]


@dataclass(frozen=True)
class TableComparison:
    """One table of both folders.

    Attributes:
        name: of the file.
        identical: whether the files have the same bytes.
        counts: rows that are the same, overlap, differ.
        differences: every interval that does not overlap.
        only_a: keys of rows, of tasks that both ran, that B lacks.
        only_b: the same the other way round.
        tasks: tasks that only one folder ran.
    """

    name: str
    identical: bool
    counts: dict[str, int]
    differences: list[Difference] = field(default_factory=list)
    only_a: list[tuple[str, ...]] = field(default_factory=list)
    only_b: list[tuple[str, ...]] = field(default_factory=list)
    tasks: list[str] = field(default_factory=list)

    @property
    def verdict(self) -> str:
        """The worst of its rows; rows that one folder lacks differ."""
        if self.counts[DIFFERS] or self.only_a or self.only_b:
            return DIFFERS
        return OVERLAP if self.counts[OVERLAP] else SAME


def compare(a: Path, b: Path) -> list[TableComparison]:
    """Compare every table that both folders have.

    Raises:
        ValueError: a folder has no leaderboard, or they have no task in common.
    """
    for folder in (a, b):
        if not (folder / "leaderboard.csv").is_file():
            raise ValueError(f"{folder} is no result folder: it has no leaderboard.csv (results/ is the committed one)")
    names = [name for name in TABLES if (a / name).is_file() and (b / name).is_file()]
    tables = [_compare(name, a / name, b / name) for name in names]
    if not sum(tables[0].counts.values()):
        raise ValueError(f"{a} and {b} have no row of leaderboard.csv in common: they ran other tasks or methods")
    return tables


def _compare(name: str, first: Path, second: Path) -> TableComparison:
    identical = first.read_bytes() == second.read_bytes()
    one, other = read_csv(first), read_csv(second)
    alone = sorted(set(one["task"]) ^ set(other["task"]))
    one, other = one[~one["task"].isin(alone)], other[~other["task"].isin(alone)]
    key = [column for column in [*KEY, "cem_seed"] if column in one and column in other]
    scores = _scores(one, other)
    if name == "cem_seeds.csv":  # the spread of CEM over its seeds: the range is the interval
        key = [column for column in key if column not in ("learner", "cem_seed")]
        one, other = _ranges(one, key), _ranges(other, key)
        scores = {"threshold": ("threshold_lo", "threshold_hi")}
    left, right = _keyed(one, key, first), _keyed(other, key, second)
    both = left.index.intersection(right.index)
    only_a, only_b = left.index.difference(right.index), right.index.difference(left.index)
    counts, differences = dict.fromkeys((SAME, OVERLAP, DIFFERS), 0), []
    shared = [column for column in left if column in right]
    same = _equal(left.loc[both, shared], right.loc[both, shared])
    found = [_differences(left.loc[both], right.loc[both], score, ends) for score, ends in scores.items()]
    for position, row in enumerate(both):
        here = [each for column in found if (each := column[position]) is not None]
        differences += [Difference(_text(row), each.score, each.a, each.b) for each in here]
        counts[SAME if same[position] else DIFFERS if here else OVERLAP] += 1
    return TableComparison(
        name, identical, counts, differences, [_text(row) for row in only_a], [_text(row) for row in only_b], alone
    )


def _scores(one: pd.DataFrame, other: pd.DataFrame) -> dict[str, tuple[str, str]]:
    """Scores with an interval in both tables: `x_lo`, `x_hi`, or over learner seeds `x_min`, `x_max`."""
    columns = [column for column in one if column in other]
    pairs = {}
    for low, high in (("_lo", "_hi"), ("_min", "_max")):
        for column in columns:
            score = column.removesuffix(low)
            if column.endswith(low) and score + high in columns and "_learner" not in score:
                pairs[score] = (column, score + high)
    return pairs


def _ranges(frame: pd.DataFrame, key: list[str]) -> pd.DataFrame:
    """Smallest and largest threshold over learners and CEM's seeds."""
    groups = frame.groupby(key, sort=True)["threshold"]
    return pd.DataFrame({"threshold_lo": groups.min(), "threshold_hi": groups.max()}).reset_index()


def _keyed(frame: pd.DataFrame, key: list[str], path: Path) -> pd.DataFrame:
    names = {column: ["" if value != value else str(value) for value in frame[column]] for column in key}  # NaN: ""
    keyed = frame.assign(**names).set_index(key)
    if keyed.index.has_duplicates:
        raise ValueError(f"{path} has two rows of {keyed.index[keyed.index.duplicated()][0]}")
    return keyed


def _equal(left: pd.DataFrame, right: pd.DataFrame) -> np.ndarray:
    """(n,) rows that agree in every column; empty cells are equal."""
    return ((left == right) | (left.isna() & right.isna())).all(axis=1).to_numpy()


def _differences(left: pd.DataFrame, right: pd.DataFrame, score: str, ends: tuple[str, str]) -> list[Difference | None]:
    """Per row, the two intervals where they do not overlap; a score that only one side has is a difference."""
    low_a, high_a = (left[end].to_numpy(float) for end in ends)
    low_b, high_b = (right[end].to_numpy(float) for end in ends)
    apart = (low_a > high_b) | (low_b > high_a) | (np.isnan(low_a) != np.isnan(low_b))
    return [
        Difference((), score, (float(low_a[i]), float(high_a[i])), (float(low_b[i]), float(high_b[i]))) if bad else None
        for i, bad in enumerate(apart)
    ]


def _text(row: object) -> tuple[str, ...]:
    return tuple(str(value) for value in row) if isinstance(row, tuple) else (str(row),)
