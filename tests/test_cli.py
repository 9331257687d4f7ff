"""The command line: what it lists, refuses and runs, and its exit codes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from micro import MICRO
from safeswitch import cli, doctor, registry, suite
from safeswitch.console import console
from safeswitch.doctor import Check
from safeswitch.pipeline import STAGES

COMMANDS = ("bench", "report", "demos", "train", "evaluate", "submit", "leaderboard", "verify", "score", "compare")
COMMANDS += ("reference", "gate", "list", "play", "doctor")


def run(capsys: Any, *arguments: str) -> tuple[int, str]:
    """Exit code and output, with the white space that the terminal's width decides taken out."""
    code = cli.main(list(arguments))
    captured = capsys.readouterr()
    return code, " ".join((captured.out + captured.err).split())


@pytest.fixture(autouse=True)
def _loud(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "quiet", False)
    monkeypatch.setenv("COLUMNS", "200")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("micro-cli")


@pytest.fixture
def micro(monkeypatch: pytest.MonkeyPatch, store: Path) -> list[str]:
    """Options that run the micro profile in this process."""
    monkeypatch.setitem(suite.PROFILES, "micro", MICRO)
    return ["--profile", "micro", "--task", "cart-pole", "--jobs", "1", "--store", str(store)]


def test_list_names_everything(capsys: Any) -> None:
    code, text = run(capsys, "list")
    assert code == 0
    for name in (*suite.PROFILES, *registry.names("method"), *registry.names("signal"), *registry.names("learner")):
        assert name in text
    for task in suite.TASKS.values():
        assert task.name in text and all(cell.disturbance in text for cell in task.cells)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["bench", "--profile", "smok"], "unknown profile 'smok'; valid, nearest first: smoke"),
        (["bench", "--task", "cartpole"], "unknown task 'cartpole'; valid, nearest first: cart-pole"),
        (["demos", "--profile", "fulll"], "unknown profile 'fulll'; valid, nearest first: full"),
        (["train", "--jobs", "0"], "--jobs must be at least 1"),
        (["evaluate", "--method", "cemm@total"], "unknown method 'cemm'; valid, nearest first: cem"),
        (["evaluate", "--method", "cem"], "write 'cem@total'"),
        (["evaluate", "--learner", "bayesian-mlp"], "a learner is for one task: add --task"),
        (["evaluate", "--task", "cart-pole", "--learner", "bayesian-mpl"], "unknown learner 'bayesian-mpl'; valid"),
        (["evaluate", "--task", "cart-pole", "--rule", "timer", "--signals", "totl"], "unknown signal 'totl'; valid"),
        (["submit", "--name", "a", "--authors", "b"], "a submission is about one task: add --task"),
        (["evaluate", "--protocol", "onse"], "unknown protocol 'onse'; valid, nearest first: onset"),
        (["evaluate", "--disturbance", "cart-mas"], "unknown cell 'cart-pole/cart-mas-3'; valid, nearest first"),
        (["evaluate", "--disturbance", "none"], "has no onset: score it with --protocol start"),
        (["play", "--task", "cart-pole", "--out", "film.avi"], ".mp4 or .gif"),
    ],
)
def test_bad_input_is_exit_code_2_with_the_nearest_names(
    capsys: Any, tmp_path: Path, arguments: list[str], message: str
) -> None:
    options = [] if "--store" in arguments else ["--store", str(tmp_path / "store")]
    code, text = run(capsys, *arguments, *options)
    assert code == 2 and "error:" in text and message in text
    assert not (tmp_path / "store").exists(), "refused before anything is computed"


@pytest.mark.parametrize("arguments", [["benchh"], ["bench", "--no-such-option"], ["bench", "--jobs", "two"]])
def test_commands_and_options_that_do_not_exist_are_exit_code_2(capsys: Any, arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        cli.main(arguments)
    assert stopped.value.code == 2
    capsys.readouterr()


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help(capsys: Any, command: str) -> None:
    with pytest.raises(SystemExit) as stopped:
        cli.main([*filter(None, [command]), "--help"])
    assert stopped.value.code == 0
    text = capsys.readouterr().out
    assert all(name in text for name in COMMANDS) if not command else "usage: safeswitch" in text


def test_the_installed_command_is_this_one() -> None:
    done = subprocess.run([Path(sys.executable).parent / "safeswitch", "list"], capture_output=True, text=True)
    assert done.returncode == 0 and "cart-pole" in done.stdout and not done.stderr


def test_doctor_exit_code(capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    good, bad = Check("Python", True, "3.11.7"), Check("disk", False, "full", "free some")
    for checks, expected in (([good], 0), ([good, bad], 1)):
        monkeypatch.setattr(doctor, "CHECKS", [lambda check=check: check for check in checks])
        code, text = run(capsys, "doctor")
        assert code == expected and "Python" in text
        assert ("free some" in text) == bool(expected)


@pytest.mark.slow
def test_demos_train_and_evaluate(capsys: Any, micro: list[str], store: Path) -> None:
    code, text = run(capsys, "demos", *micro)
    assert code == 0 and "safeswitch/cart-pole/expert-v0" in text and list(store.glob("demonstrations-*"))
    code, text = run(capsys, "train", *micro)
    assert code == 0 and "cart-pole learner 0" in text
    for method, protocol in (("cem@total", "onset"), ("learner", "start"), ("fixed-q95@epistemic", "start")):
        code, text = run(capsys, "evaluate", *micro, "--method", method, "--protocol", protocol)
        assert code == 0, text
        assert method in text and "return_mean" in text and "success" in text
    outsider = "safeswitch_baselines.rules.bounds:ExpertOnly"
    code, text = run(capsys, "evaluate", *micro, "--method", outsider)
    assert code == 0 and outsider in text


@pytest.mark.slow
@pytest.mark.rendering
def test_play_writes_a_film(capsys: Any, micro: list[str], tmp_path: Path) -> None:
    for driver in ("learner", "expert", "cem@total", "periodic"):
        film = tmp_path / f"{driver.partition('@')[0]}.gif"
        code, text = run(capsys, "play", *micro, "--driver", driver, "--out", str(film))
        assert code == 0, text
        assert film.stat().st_size > 1000 and "handover" in text
    code, text = run(capsys, "play", *micro, "--driver", "oracle-hindsight", "--out", str(tmp_path / "no.gif"))
    assert code == 2 and "hindsight" in text


@pytest.mark.slow
@pytest.mark.rendering
def test_bench_writes_the_results(capsys: Any, micro: list[str], tmp_path: Path) -> None:
    code, text = run(capsys, "bench", *micro, "--results", str(tmp_path / "results"))
    assert code == 0, text
    assert f"In {tmp_path / 'results'}: leaderboard.md" in text, "where the files are"
    for name in ("leaderboard.csv", "leaderboard.md", "signals.csv", "comparisons.csv", "manifest.json"):
        assert (tmp_path / "results" / name).stat().st_size > 0
    assert (tmp_path / "results" / "figures" / "cart-pole" / "cem-total-onset.png").exists()
    assert (tmp_path / "results" / "tables" / "cart-pole" / "thresholds.csv").exists()
    assert str(tmp_path / "results" / "report.html") in text and (tmp_path / "results" / "report.html").exists()
    before = (tmp_path / "results" / "leaderboard.csv").read_bytes()
    assert "armed at onset" in text and "oracle-hindsight" in text and "manifest.json" in text, "the summary"
    code = cli.main(["bench", *micro, "--results", str(tmp_path / "results"), "--json"])
    assert code == 0 and (tmp_path / "results" / "leaderboard.csv").read_bytes() == before
    data = json.loads(capsys.readouterr().out)
    assert data["results"] == str(tmp_path / "results") and Path(data["files"]["leaderboard.csv"]).is_file()
    assert {row["method"] for row in data["headline"]} >= {"learner", "expert", "cem@total"}
    assert set(data["stage_seconds"]["cart-pole"]) <= set(STAGES)
