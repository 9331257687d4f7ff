"""The guides for outsiders: their code is run as it stands, and their excerpts are those of the examples."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from safeswitch import registry
from safeswitch.protocols import SwitchRule

ROOT = Path(__file__).resolve().parents[1]
GUIDES = ("add_a_learner.md", "add_a_rule.md", "add_a_task.md", "submit.md")
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FILE = re.compile(r"# ([\w/]+\.py)\n")


def blocks(guide: str, language: str) -> Iterator[str]:
    for found, code in BLOCK.findall((ROOT / "docs" / guide).read_text()):
        assert found in ("python", "bash", "toml"), f"{guide} has a block in {found!r}, which nothing checks"
        if found == language:
            yield code


def write_files(guide: str, folder: Path) -> list[str]:
    """Write the modules that a guide shows whole; returns their names."""
    names = []
    for code in blocks(guide, "python"):
        if (named := FILE.match(code)) and not named[1].startswith("examples/"):
            (folder / named[1]).write_text(code)
            names.append(named[1])
    return names


@pytest.mark.parametrize("guide", GUIDES)
def test_excerpts_are_those_of_the_examples(guide: str) -> None:
    for code in blocks(guide, "python"):
        if (named := FILE.match(code)) and named[1].startswith("examples/"):
            assert code[named.end() :] in (ROOT / named[1]).read_text(), f"{guide}: {code}"


@pytest.mark.parametrize("guide", GUIDES)
def test_links_lead_somewhere(guide: str) -> None:
    for target in re.findall(r"\]\(([\w./]+)\)", (ROOT / "docs" / guide).read_text()):
        assert (ROOT / "docs" / target).is_file(), target
    for target in re.findall(r"`(examples/[\w/.]+)`", (ROOT / "docs" / guide).read_text()):
        assert (ROOT / target).exists(), target


def test_what_the_guides_show_satisfies_the_protocols(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert write_files("add_a_learner.md", tmp_path) == ["my_learner.py"]
    assert write_files("add_a_rule.md", tmp_path) == ["my_switch.py", "my_signal.py"]
    monkeypatch.syspath_prepend(str(tmp_path))
    assert hasattr(registry.find("learner", "my_learner:Neighbours"), "predict")
    rule: Any = registry.make_method("my_switch:ThreeInARow").calibrate(None).rule  # type: ignore[arg-type]
    assert isinstance(rule, SwitchRule)
    rule.reset(0)
    answers = [rule.update(step, {"total": value}) for step, value in enumerate((0.2, 0.2, 0.1, 0.2, 0.2, 0.2, 0.0))]
    assert answers == [0, 0, 0, 0, 0, 1, 1]
    signal = registry.make_signal("my_signal:Jerk-mean3")
    assert signal.id == "my_signal:Jerk-mean3"


def test_the_code_of_the_task_guide_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "add_a_task"))
    names: dict[str, Any] = {}
    for code in blocks("add_a_task.md", "python"):
        if not FILE.match(code):
            exec(compile(code, "add_a_task.md", "exec"), names)
    assert names["env"].is_success


@pytest.mark.slow
@pytest.mark.parametrize("guide", GUIDES)
def test_the_commands_of_the_guides_work_away_from_the_checkout(guide: str, tmp_path: Path) -> None:
    shutil.copytree(ROOT / "examples", tmp_path / "examples", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("numpy_learner.py", "my_rule.py"):
        shutil.copy(ROOT / "examples" / name, tmp_path)
    write_files(guide, tmp_path)
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {**os.environ, "PATH": path, "SAFESWITCH_STORE": str(tmp_path / "store"), "COLUMNS": "150"}
    environment.pop("PYTHONPATH", None)
    script = "set -e\n" + "".join(blocks(guide, "bash"))
    done = subprocess.run(["bash", "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    if guide == "submit.md":
        assert "verified" in done.stdout and "1 merged, 0 refused" in done.stdout
        (submission,) = (tmp_path / "try" / "submissions").glob("*.json")
        submission.write_text(re.sub(r'"return_mean": [\d.]+', '"return_mean": 5.999', submission.read_text(), count=1))
        command = ["safeswitch", "leaderboard", "--results", "try", "--minimum-episodes", "4"]
        refused = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert refused.returncode == 1 and "scores.return_mean is 5.999" in refused.stdout
