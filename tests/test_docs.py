"""The documentation: every code block works, every quoted number is that of the tables, every link leads somewhere.

Python blocks of one page are run in order in one namespace, in an empty folder. Shell blocks are parsed by the shell
and by the command line; those that cost nothing are run. A page with the comment `<!-- blocks: slow -->` is run with
the slow tests, one with `<!-- blocks: tests/test_NAME.py -->` has a test of its own.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import tyro

from safeswitch import cli

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("assets/*.md")])
BLOCK = re.compile(r"^(?P<indent> *)```(?P<language>\w*)\n(?P<code>.*?)^(?P=indent)```", re.MULTILINE | re.DOTALL)
SHELL = ("sh", "bash", "console", "shell")
RUN = ("safeswitch list", "safeswitch list --json", "make help")
"""Commands in shell blocks that cost nothing and are run."""
OUTSIDE = {"pip", "git", "cd", "export", "python", "jupyter", "tensorboard", "pytest", "pre-commit", "cat", "true"}

pytestmark = pytest.mark.skipif(not (ROOT / "pyproject.toml").is_file(), reason="needs the checkout")


def blocks(page: Path, *languages: str) -> list[str]:
    """Code blocks of a page in these languages, without their indentation."""
    found = BLOCK.finditer(page.read_text())
    return [
        "\n".join(line.removeprefix(match["indent"]) for line in match["code"].splitlines()) + "\n"
        for match in found
        if match["language"] in languages
    ]


def with_python() -> list[object]:
    pages = []
    for page in PAGES:
        text = page.read_text()
        own = re.search(r"<!-- blocks: (?P<what>\S+) -->", text)
        if blocks(page, "python") and (own is None or own["what"] == "slow"):
            pages.append(pytest.param(page, id=page.name, marks=[pytest.mark.slow] if own else []))
        elif own is not None and own["what"] != "slow":
            assert (ROOT / own["what"]).is_file(), f"{page.name}: {own['what']} does not exist"
    return pages


@pytest.mark.parametrize("page", with_python())
def test_python_blocks_run(page: Path, tmp_path: Path) -> None:
    code = "\n".join(blocks(page, "python"))
    script = tmp_path / f"{page.stem}.py"
    script.write_text(code)
    environment = {**os.environ, "MINARI_DATASETS_PATH": str(tmp_path / "minari")}
    done = subprocess.run([sys.executable, script.name], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{page.name}:\n{code}\n{done.stdout[-1500:]}\n{done.stderr[-3000:]}"


def commands(page: Path) -> list[list[str]]:
    """Commands of the shell blocks of a page, as words without comments and leading assignments."""
    lines = [line for block in blocks(page, *SHELL) for line in block.replace("\\\n", " ").splitlines()]
    parts = [part.removeprefix("$ ") for line in lines for part in re.split(r" && | \|\|? ", line)]
    split = [shlex.split(part, comments=True) for part in parts]
    return [words for words in map(without_assignments, split) if words]


def without_assignments(words: list[str]) -> list[str]:
    while words and re.match(r"[A-Z_]+=", words[0]):
        words = words[1:]
    return words


def with_shell() -> list[object]:
    return [pytest.param(page, id=page.name) for page in PAGES if blocks(page, *SHELL)]


@pytest.mark.parametrize("page", with_shell())
def test_shell_blocks_parse_and_name_commands_that_exist(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    for block in blocks(page, *SHELL):
        subprocess.run(["bash", "-n"], input=block, text=True, check=True)
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for words in commands(page):
        name, rest = Path(words[0]).name, words[1:]
        if name == "safeswitch":
            assert "--help" in rest or tyro.cli(cli.Command, args=rest) is not None  # type: ignore[call-overload]
        elif name == "make":
            named = [word for word in rest if "=" not in word and not word.startswith("-")]
            assert set(named) <= targets, f"{page.name}: make {' '.join(named)}"
        else:
            assert name in OUTSIDE, f"{page.name}: {words}"
        if " ".join([name, *rest]) in RUN:
            program = str(Path(sys.executable).parent / "safeswitch") if name == "safeswitch" else name
            subprocess.run([program, *rest], cwd=ROOT, check=True, capture_output=True)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files_that_exist(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        path = target.partition("#")[0]
        if path and "://" not in path and not path.startswith(("mailto:", "api/")):
            assert (page.parent / path).exists(), f"{page.name} links to {target}"


# ---- numbers


@pytest.fixture(scope="module")
def quotes() -> ModuleType:
    spec = importlib.util.spec_from_file_location("quote_results", ROOT / "scripts" / "quote_results.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_quoted_numbers_are_those_of_the_tables(quotes: ModuleType) -> None:
    counted = 0
    for page in quotes.pages():
        text = page.read_text()
        counted += len(quotes.NUMBER.findall(text))
        assert quotes.current(text) == text, f"{page.name} is stale: python scripts/quote_results.py --write"
        unread = text.count("<!--= ") - len(quotes.NUMBER.findall(text))
        assert not unread or page.name == "contributing.md", f"{page.name}: {unread} quotes stand after no number"
    assert counted > 30


def test_a_small_negative_number_keeps_its_sign_unless_no_digit_is_left(quotes: ModuleType) -> None:
    shown = {"-0.00": "0.00", "-0.001": "-0.001", "-0": "0", "-10.00": "-10.00", "+0.00": "+0.00", "–": "–"}
    assert {text: quotes.unsigned_zero(text) for text in shown} == shown


def test_a_number_that_is_off_is_found_and_put_right(quotes: ModuleType) -> None:
    where = "<!--= leaderboard cart-pole/cart-mass-3 onset expert return_mean -->"
    assert quotes.current(f"5.01{where} and +4.9{where}") == f"5.00{where} and +5.0{where}"
    table = "<!--rows leaderboard cart-pole/none start: learner -->\n{}<!--/rows-->"
    right = quotes.current(table.format("| old |\n"))
    assert "| `learner` |" in right and "old" not in right and quotes.current(right) == right


def test_a_table_of_signals_has_a_row_for_each_that_the_rules_run_on(quotes: ModuleType) -> None:
    block = "<!--signals cart-pole/repaint-3 start harm/false_alarms: cem -->\n{}<!--/signals-->"
    text = quotes.current(block.format(""))
    assert re.search(r"\| `total` \| \d\.\d\d / \d\.\d\d \|", text) and text == quotes.current(text)
    with pytest.raises(ValueError, match="no method nothing@"):
        quotes.current(block.format("").replace("cem", "nothing"))


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("leaderbord cart-pole/none start expert return_mean", "no table 'leaderbord'"),
        ("leaderboard cart-pole/none start nobody return_mean", "0 rows"),
        ("leaderboard cart-pole/none start expert retrun", "no column 'retrun'"),
    ],
)
def test_a_quote_of_nothing_is_an_error(quotes: ModuleType, where: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        quotes.current(f"1.0<!--= {where} -->")


# ---- the site and the notebooks


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("sphinx", reason="needs the extra `docs`")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-n", "-q", "-E", "-d", str(tmp_path / "trees")]
    done = subprocess.run([*command, str(ROOT / "docs"), str(tmp_path / "html")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    for name in ("index", "tutorial", "findings", "cart_pole", "api/safeswitch.protocols"):
        assert (tmp_path / "html" / f"{name}.html").is_file()


NOTEBOOKS = sorted(ROOT.glob("examples/*.ipynb"))


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_notebooks_run_from_top_to_bottom(path: Path, tmp_path: Path) -> None:
    nbformat = pytest.importorskip("nbformat", reason="needs the extra `docs`")
    nbclient = pytest.importorskip("nbclient", reason="needs the extra `docs`")
    notebook = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs), "it draws something"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_notebooks_are_committed_without_outputs(path: Path) -> None:
    text = path.read_text()
    assert '"outputs": []' in text and not re.search(r'"outputs": \[\s*\{', text)
    assert not re.search(r'"execution_count": \d', text)


def test_there_are_two_notebooks() -> None:
    assert {path.name for path in NOTEBOOKS} >= {"reproduce_figure_1.ipynb", "add_your_own_rule.ipynb"}
