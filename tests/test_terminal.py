"""What people see: bars on a terminal, plain lines elsewhere, JSON for programs, and a clean stop on Ctrl-C."""

from __future__ import annotations

import io
import json
import os
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from micro import MICRO, TASK
from safeswitch import cli, console, durations, execution, suite
from safeswitch.console import Progress, StageError
from safeswitch.files import load_json
from safeswitch.interrupts import for_this_process_alone
from safeswitch.pipeline import Run
from safeswitch.scoring.leaderboard import read_csv
from safeswitch.store import Store
from safeswitch.suite import TASKS, Task
from safeswitch.summary import announcement, headline, headline_table

CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f\x9b]")  # all but newline and tab; \r and \x1b are among them

SCRIPT = """
import sys, time
from micro import MICRO
from safeswitch import cli, suite
from safeswitch.console import Progress
if __name__ == "__main__":
    suite.PROFILES["micro"] = MICRO
    if sys.argv[1] == "stages":
        for label, done in (("task 1/2 first", 0), ("task 2/2 second", 2)):
            with Progress(label, 2, done, expected=60.0) as progress:
                for _ in range(2 - done):
                    time.sleep(0.3)
                    progress.advance()
    else:
        sys.exit(cli.main(sys.argv[1:]))
"""


def environment(**changes: str | None) -> dict[str, str]:
    values = {name: value for name, value in os.environ.items() if name not in ("NO_COLOR", "FORCE_COLOR", "COLUMNS")}
    values |= {"TERM": "xterm-256color", "PYTHONPATH": str(Path(__file__).parent)}
    return values | {name: value for name, value in changes.items() if value is not None}


@pytest.fixture
def script(tmp_path: Path) -> str:
    path = tmp_path / "terminal.py"
    path.write_text(SCRIPT)
    return str(path)


class Terminal:
    """A command on a pseudo-terminal of 100 columns."""

    def __init__(self, command: list[str], **changes: str):
        import fcntl
        import pty
        import struct
        import termios

        self.text = ""
        pid, self.descriptor = pty.fork()
        if pid == 0:
            # Shells start background commands with Ctrl-C ignored, and children inherit that; a terminal's do hear it.
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            os.execve(command[0], command, environment(**changes))
        self.pid = pid
        fcntl.ioctl(self.descriptor, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 100, 0, 0))

    def read(self, until: Callable[[str], bool] = lambda text: False, seconds: float = 300) -> str:
        """Output up to the end, or until it satisfies `until`."""
        deadline = time.monotonic() + seconds
        while not until(self.text):
            if time.monotonic() > deadline:
                os.kill(self.pid, signal.SIGKILL)
                raise TimeoutError(self.text[-500:])
            if select.select([self.descriptor], [], [], 0.1)[0]:
                try:
                    data = os.read(self.descriptor, 65536)
                except OSError:  # Linux: the other side is closed
                    data = b""
                if not data:
                    break
                self.text += data.decode(errors="replace")
        return self.text

    def exit_code(self) -> int:
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


needs_terminal = pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")


@needs_terminal
def test_on_a_terminal_there_is_a_bar_with_the_time_left(script: str) -> None:
    terminal = Terminal([sys.executable, script, "stages"])
    text = terminal.read()
    assert terminal.exit_code() == 0
    assert "\x1b[" in text and "━" in text, "colours and a bar"
    assert re.search(r"about (59|60|1 min 00) ?s? left", text), "the guess, before the first job has ended"
    assert "1/2" in text and "2/2" in text and "kept from before" in text
    assert text.rstrip().endswith("\x1b[?25h") or "\x1b[?25h" in text, "the cursor is shown again"


@needs_terminal
@pytest.mark.parametrize("changes", [{"NO_COLOR": "1"}, {"TERM": "dumb"}])
def test_no_color_and_dumb_terminals_get_plain_lines(script: str, changes: dict[str, str]) -> None:
    text = Terminal([sys.executable, script, "stages"], **changes).read().replace("\r\n", "\n")
    assert not CONTROL.search(text), repr(text)
    assert len(text.strip().splitlines()) == 2


def test_without_a_terminal_there_is_one_line_a_stage(script: str) -> None:
    done = subprocess.run([sys.executable, script, "stages"], env=environment(), capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout == ""
    first, second = done.stderr.strip().splitlines()
    assert re.fullmatch(r"task 1/2 first: 2 to do \.\.\. done in \d+\.\d s", first)
    assert second == "task 2/2 second: kept from before"
    assert not CONTROL.search(done.stderr)


def progress(monkeypatch: pytest.MonkeyPatch, *arguments: Any) -> tuple[Progress, dict[str, float]]:
    clock = {"now": 100.0}
    monkeypatch.setattr(console.time, "perf_counter", lambda: clock["now"])
    monkeypatch.setattr(console, "log", Console(file=io.StringIO()))
    return Progress(*arguments), clock


def test_the_time_left_is_first_the_guess_and_then_what_jobs_took(monkeypatch: pytest.MonkeyPatch) -> None:
    bar, clock = progress(monkeypatch, "label", 5, 1, 40.0)
    clock["now"] += 5
    assert bar.left == 35.0
    clock["now"] += 3
    bar.advance()
    assert bar.left == 24.0, "three more of 8 s"
    clock["now"] += 4
    assert bar.left == 20.0
    shares = [bar.share]
    for _ in range(3):
        bar.advance()
        shares.append(bar.share)
    assert bar.left == 0.0 and shares == sorted(shares) and shares[-1] == 1.0 and shares[0] > 0.2


def test_without_a_guess_the_time_left_is_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    bar, clock = progress(monkeypatch, "label", 2, 0)
    clock["now"] += 5
    assert bar.left is None and bar.share == 0.0


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0 s"), (59.4, "59 s"), (59.6, "1 min 00 s"), (725, "12 min 05 s"), (4830, "1 h 20 min")],
)
def test_durations_are_readable(seconds: float, text: str) -> None:
    assert console.duration(seconds) == text


# ---- guesses


def test_shipped_durations_are_of_stages_that_exist() -> None:
    for task, profiles in load_json(durations.SHIPPED).items():
        for profile, stages in profiles.items():
            assert set(stages) <= set(Run(suite.task(task), suite.profile(profile), Store("unused")).stages)


def test_a_guess_comes_from_the_last_run_in_the_folder_if_it_was_alike(tmp_path: Path) -> None:
    stages = {"training": {"wall, this run": 1.0, "work, when computed": 90.0, "jobs": 3}}
    entry = {"profile": "standard", "stage_seconds": stages}
    (tmp_path / "manifest.json").write_text(json.dumps({"cart-pole": entry}))
    found = durations.stages("cart-pole", "standard", tmp_path)
    assert durations.total(found, workers=2) == 45.0
    assert durations.of_stage([(found, 3)], "training", workers=2) == 60.0, "two rounds of 30 s"
    assert durations.of_stage([(found, 1)], "training", workers=2) == 30.0
    assert durations.of_stage([(found, 1)], "figures", workers=2) is None
    longer = {"training": durations.Stage(work=200.0, jobs=1)}
    assert durations.of_stage([(found, 1), (longer, 1)], "training", workers=2) == 200.0, "side by side"
    assert durations.of_stage([(found, 6), (longer, 1)], "training", workers=2) == 190.0 + 10.0, (
        "no less than the longest"
    )
    assert durations.of_stage([(found, 1), ({}, 1)], "training", workers=2) is None
    assert set(durations.stages("cart-pole", "smoke", tmp_path)) > {"training"}, "another profile: the shipped ones"
    assert durations.total(durations.stages("cart-pole", "nothing", tmp_path), 2) is None


def test_tasks_that_are_trained_side_by_side_take_less_time_together() -> None:
    one = {"training": durations.Stage(20.0, 1), "figures": durations.Stage(10.0, 1)}
    other = {"training": durations.Stage(200.0, 1), "switch rules": durations.Stage(60.0, 3)}
    assert durations.together([one, other], workers=2) == 200.0 + 10.0 + 30.0
    assert durations.together([one, other], workers=1) == 220.0 + 10.0 + 60.0
    assert durations.together([one], workers=2) == durations.total(one, 2)
    assert durations.together([one, {}], workers=2) == durations.total(one, 2)


def test_the_announcement_says_how_long_and_where(tmp_path: Path) -> None:
    tasks = [suite.task("cart-pole"), suite.task("cart-pole-image")]
    lines = announcement([Run(task, suite.profile("standard"), Store(tmp_path)) for task in tasks], tmp_path / "out")
    text = "\n".join(lines)
    assert "standard" in text and "cart-pole-image" in text and "2 workers" in text
    assert re.search(r"roughly \d+ min \d\d s from scratch", text) and str(tmp_path / "out") in text
    unknown = announcement([Run(TASK, MICRO, Store(tmp_path))], tmp_path / "out")
    assert "unknown" in "\n".join(unknown)


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_the_headline_is_that_of_the_committed_leaderboard(task: Task) -> None:
    path = Path(__file__).resolve().parents[1] / "results" / "leaderboard.csv"
    if not path.is_file():
        pytest.skip("needs the committed results")
    rows = headline(task, read_csv(path))
    shown = headline_table(rows)
    assert shown.row_count == len(rows) + 2, "a line for each protocol and each method"
    console = Console(file=io.StringIO(), width=80)
    console.print(shown)
    assert "…" not in console.file.getvalue(), "whole in 80 columns"  # type: ignore[attr-defined]
    by = {(row["protocol"], row["method"]): row for row in rows}
    for protocol in ("onset", "start"):
        best = [row for row in rows if row["protocol"] == protocol and "best rule" in row["role"]]
        assert len(best) == 1 and by[protocol, "oracle-hindsight"]["return_mean"] >= best[0]["return_mean"]
        assert {(protocol, name) for name in ("learner", "expert", "timer", "cem@total")} <= set(by)
    assert by["start", "expert"]["autonomy"] == 0


# ---- exit codes and answers


def test_json_answers_are_one_document(capsys: Any) -> None:
    assert cli.main(["list", "--json"]) == 0
    names = json.loads(capsys.readouterr().out)
    assert "smoke" in names["profiles"] and "cem" in names["methods"]


def test_bad_input_is_said_on_standard_error_even_if_quiet(capsys: Any) -> None:
    assert cli.main(["bench", "--profile", "smok", "--quiet"]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and "nearest first: smoke" in captured.err


def test_a_stage_that_breaks_is_exit_code_1_with_the_place(
    capsys: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def broken(root: str, job: Any) -> str:
        raise ZeroDivisionError("in somebody's learner")

    monkeypatch.setattr(execution, "run_job", broken)
    monkeypatch.setitem(suite.PROFILES, "micro", MICRO)
    options = ["--profile", "micro", "--task", "cart-pole", "--jobs", "1", "--store", str(tmp_path)]
    assert cli.main(["train", *options]) == 1
    error = capsys.readouterr().err
    assert "cart-pole: demonstrations failed: ZeroDivisionError: in somebody's learner" in error
    assert "in broken" in error, "the traceback names the function"


def test_a_setting_that_a_stage_refuses_is_bad_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(root: str, job: Any) -> str:
        raise ValueError("no such learner option")

    monkeypatch.setattr(execution, "run_job", refuse)
    run = Run(TASK, MICRO, Store(tmp_path), workers=1)
    with pytest.raises(ValueError, match="no such learner option"):
        _ = run.demonstrations
    monkeypatch.setattr(execution, "run_job", lambda root, job: 1 / 0)
    with pytest.raises(StageError):
        _ = Run(TASK, MICRO, Store(tmp_path), workers=1).demonstrations


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
def test_ctrl_c_is_for_this_process_and_not_for_those_that_it_starts() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # test workers ignore it
    try:
        with for_this_process_alone():
            sleeper = "import time; print('up', flush=True); time.sleep(60)"
            child = subprocess.Popen([sys.executable, "-c", sleeper], stdout=subprocess.PIPE)
            assert child.stdout is not None and child.stdout.readline() == b"up\n"
            child.send_signal(signal.SIGINT)
            time.sleep(0.2)
            assert child.poll() is None, "it does not hear SIGINT"
            with pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(5)
            child.kill()
            child.wait()
    finally:
        signal.signal(signal.SIGINT, before)
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


@needs_terminal
@pytest.mark.slow
def test_ctrl_c_on_a_terminal_stops_cleanly_and_the_next_run_goes_on(script: str, tmp_path: Path) -> None:
    options = ["--profile", "micro", "--task", "cart-pole", "--jobs", "2", "--store", str(tmp_path / "store")]
    results = tmp_path / "results"
    terminal = Terminal([sys.executable, script, "bench", *options, "--results", str(results)])
    terminal.read(until=lambda text: "handover tables" in text)
    os.write(terminal.descriptor, b"\x03")
    text = terminal.read()
    assert terminal.exit_code() == 130
    assert "the same command continues where it stopped" in text and "Traceback" not in text
    assert not results.exists(), "nothing is published half done"
    kept = Store(tmp_path / "store").keys()
    assert {key.partition("-")[0] for key in kept} >= {"demonstrations", "learner"}
    train = [sys.executable, script, "train", *options]
    done = subprocess.run([*train, "--json"], env=environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lines = [f"cart-pole {stage}: kept from before" for stage in ("demonstrations", "training")]
    assert done.stderr.splitlines() == lines and not CONTROL.search(done.stderr)
    (folder,) = json.loads(done.stdout).values()
    assert Path(folder).is_dir()
    quiet = subprocess.run([*train, "--quiet"], env=environment(), capture_output=True, text=True)
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")
