"""Comparing result folders: the same, overlapping and different ones, and the exit code that goes with it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from safeswitch import cli
from safeswitch.compare import DIFFERS, OVERLAP, SAME, compare
from safeswitch.scoring.leaderboard import read_csv, write_csv


def board(task: str = "cart-pole", shift: float = 0.0, methods: tuple[str, ...] = ("expert", "cem@total")) -> Any:
    """A small leaderboard whose returns are shifted; intervals are +-0.1 wide."""
    rows = []
    for i, method in enumerate(methods):
        mean = 5 + i / 10 + shift
        row = {"task": task, "disturbance": "cart-mass", "severity": 3, "protocol": "start", "method": method}
        row |= {"return_mean": mean, "return_lo": mean - 0.1, "return_hi": mean + 0.1, "calibrated_on": ""}
        rows.append(row | {"skill": float("nan"), "skill_lo": float("nan"), "skill_hi": float("nan")})
    return pd.DataFrame(rows)


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    for name in ("a", "b"):
        write_csv(board(), tmp_path / name / "leaderboard.csv")
        cem = board().loc[1, ["task", "disturbance", "severity", "protocol", "method"]].to_dict()
        runs = [{**cem, "learner": 0, "cem_seed": seed, "threshold": 0.1 + seed / 100} for seed in range(3)]
        spread = pd.DataFrame(runs)
        write_csv(spread, tmp_path / name / "cem_seeds.csv")
    return tmp_path / "a", tmp_path / "b"


def verdicts(a: Path, b: Path) -> dict[str, str]:
    return {table.name: table.verdict for table in compare(a, b)}


def test_the_same_bytes_are_the_same(folders: tuple[Path, Path], capsys: Any) -> None:
    assert set(verdicts(*folders).values()) == {SAME}
    assert all(table.identical for table in compare(*folders))
    assert cli.main(["compare", *map(str, folders)]) == 0
    assert "same bytes" in capsys.readouterr().out


@pytest.mark.parametrize(("shift", "verdict", "code"), [(0.15, OVERLAP, 0), (0.25, DIFFERS, 1), (-0.25, DIFFERS, 1)])
def test_intervals_decide(folders: tuple[Path, Path], capsys: Any, shift: float, verdict: str, code: int) -> None:
    a, b = folders
    write_csv(board(shift=shift), b / "leaderboard.csv")
    (table, spread) = compare(a, b)
    assert (table.verdict, spread.verdict) == (verdict, SAME)
    assert table.counts[verdict] == 2 and len(table.differences) == 2 * code
    for each in table.differences:
        assert each.score == "return" and (each.a[1] < each.b[0] or each.b[1] < each.a[0])
    assert cli.main(["compare", str(a), str(b), "--json"]) == code
    printed = json.loads(capsys.readouterr().out)
    assert printed["agree"] == (not code) and printed["tables"][0]["verdict"] == verdict
    assert cli.main(["compare", str(b), str(a)]) == code, "either way round"
    assert ("cem@total" in capsys.readouterr().out) == bool(code)


def test_missing_methods_differ_and_other_tasks_are_not_compared(folders: tuple[Path, Path], capsys: Any) -> None:
    a, b = folders
    write_csv(pd.concat([board(), board("cart-pole-image", 1.0)]), b / "leaderboard.csv")
    assert verdicts(a, b)["leaderboard.csv"] == SAME
    assert cli.main(["compare", str(a), str(b)]) == 0
    assert "only one folder ran it: cart-pole-image" in capsys.readouterr().out
    write_csv(board(methods=("expert",)), b / "leaderboard.csv")
    (table, _) = compare(a, b)
    assert table.verdict == DIFFERS and "cem@total" in table.only_a[0] and not table.only_b


def test_a_score_that_applies_on_one_side_only_differs(folders: tuple[Path, Path]) -> None:
    a, b = folders
    changed = board()
    changed.loc[1, ["skill", "skill_lo", "skill_hi"]] = 0.5, 0.4, 0.6
    write_csv(changed, b / "leaderboard.csv")
    (difference,) = compare(a, b)[0].differences
    assert difference.score == "skill" and "cem@total" in difference.row


def test_the_spread_of_cem_is_compared_as_a_range(folders: tuple[Path, Path]) -> None:
    a, b = folders
    spread = read_csv(b / "cem_seeds.csv")
    for shift, verdict in ((0.01, OVERLAP), (0.5, DIFFERS)):
        write_csv(spread.assign(threshold=spread["threshold"] + shift), b / "cem_seeds.csv")
        assert verdicts(a, b)["cem_seeds.csv"] == verdict


def test_folders_that_cannot_be_compared(folders: tuple[Path, Path], tmp_path: Path, capsys: Any) -> None:
    a, b = folders
    assert cli.main(["compare", str(a), str(tmp_path / "missing")]) == 2
    assert "no result folder" in capsys.readouterr().err
    write_csv(board("cart-pole-image"), b / "leaderboard.csv")
    with pytest.raises(ValueError, match="other tasks"):
        compare(a, b)
    shutil.copy(a / "leaderboard.csv", b / "leaderboard.csv")
    with (b / "leaderboard.csv").open("a") as file:
        file.write((a / "leaderboard.csv").read_text().splitlines()[-1] + "\n")
    with pytest.raises(ValueError, match="two rows"):
        compare(a, b)
