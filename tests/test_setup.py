"""Set-up, on pretended machines: what it finds missing, whom it asks, and when it installs again."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TOOLS = ("bash", "cat", "cksum", "dirname", "env", "grep", "ls", "mktemp", "rm")

pytestmark = [
    pytest.mark.skipif(not (ROOT / "scripts" / "setup.sh").is_file(), reason="needs the checkout"),
    pytest.mark.skipif(not (3, 11) <= sys.version_info < (3, 13), reason="needs a Python that set-up accepts"),
]


class Machine:
    """A checkout and a PATH with a few real tools; every other command is a script of the test."""

    def __init__(self, folder: Path) -> None:
        self.checkout, self.path, self.log = folder / "checkout", folder / "bin", folder / "log"
        (self.checkout / "scripts").mkdir(parents=True)
        self.path.mkdir()
        for name in ("pyproject.toml", "constraints.txt", "scripts/setup.sh"):
            shutil.copy(ROOT / name, self.checkout / name)
        for tool in TOOLS:
            (self.path / tool).symlink_to(str(shutil.which(tool)))
        self.command("python3", f'exec {sys.executable} "$@"')
        self.command("uname", "echo Linux")
        self.command("id", "echo 1000")
        for compiler in ("cc", "gcc"):
            self.command(compiler, "exit 0")

    def command(self, name: str, body: str, folder: Path | None = None) -> None:
        script = (folder or self.path) / name
        script.parent.mkdir(parents=True, exist_ok=True)
        script.write_text(f'#!/bin/sh\necho "{name} $*" >> {self.log}\n{body}\n')
        script.chmod(0o755)

    def virtual_environment(self) -> None:
        """One whose pip only says what it is asked to do."""
        self.command("python", "exit 0", self.checkout / ".venv" / "bin")

    def setup(self, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        self.log.write_text("")
        variables = {"PATH": str(self.path), "HOME": str(self.path), "MUJOCO_GL": "osmesa", **environment}
        command = [str(self.path / "bash"), "scripts/setup.sh", *arguments]
        return subprocess.run(command, cwd=self.checkout, env=variables, capture_output=True, text=True, check=False)

    def calls(self, command: str) -> list[str]:
        return [line for line in self.log.read_text().splitlines() if line.startswith(f"{command} ")]

    def installs(self) -> list[str]:
        return [line for line in self.calls("python") if "pip install" in line]


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_without_root_or_sudo_the_exact_command_is_shown(machine: Machine) -> None:
    machine.command("apt-get", "exit 0")
    for compiler in ("cc", "gcc"):
        machine.command(compiler, "exit 1")
    for sudo in (False, True):  # no sudo at all; one that asks for a password
        if sudo:
            machine.command("sudo", "exit 1")
        done = machine.setup()
        assert done.returncode == 1
        assert "sudo apt-get update && sudo apt-get install -y --no-install-recommends gcc libc6-dev\n" in done.stderr
        assert "compiling the expert's solver" in done.stderr and machine.calls("apt-get") == []


@pytest.mark.parametrize("user", ["0", "1000"])
def test_missing_packages_are_installed_without_questions(machine: Machine, user: str) -> None:
    machine.virtual_environment()
    machine.command("id", f"echo {user}")
    machine.command("sudo", f'shift; case "$1" in true) exit 0;; *) SUDO=1; {machine.path}/env "$@";; esac')
    machine.command("apt-get", f'echo "frontend $DEBIAN_FRONTEND" >> {machine.log}')
    for compiler in ("cc", "gcc"):
        machine.command(compiler, "exit 1")
    done = machine.setup()
    assert done.returncode == 0, done.stderr
    update, install = machine.calls("apt-get")
    assert "update" in update and install.endswith("install -y -qq --no-install-recommends gcc libc6-dev")
    assert machine.calls("frontend") == ["frontend noninteractive"] * 2
    assert bool(machine.calls("sudo")) == (user != "0")
    assert len(machine.installs()) == 1


def test_a_package_source_that_does_not_answer_is_no_obstacle_but_a_failed_install_is(machine: Machine) -> None:
    machine.virtual_environment()
    machine.command("id", "echo 0")
    machine.command("cc", "exit 1")
    machine.command("gcc", "exit 1")
    for failing, code in (("update", 0), ("install", 1)):
        machine.command("apt-get", f'case "$*" in *{failing}*) exit 100;; esac')
        done = machine.setup()
        assert done.returncode == code and "failed" in done.stderr
    assert "as root: apt-get update && apt-get install -y gcc libc6-dev" in done.stderr


def test_egl_is_probed_unless_another_opengl_is_chosen(machine: Machine) -> None:
    machine.virtual_environment()
    machine.command("apt-get", "exit 0")
    # A libEGL that cannot be loaded, as where there is none: the probe reads its program from standard input.
    machine.command("python3", f'case "$1" in -) exit 1;; esac; exec {sys.executable} "$@"')
    for choice in ("", "egl"):
        done = machine.setup(MUJOCO_GL=choice)
        assert done.returncode == 1 and "libegl1 libgl1-mesa-dri libopengl0" in done.stderr
    assert machine.setup(MUJOCO_GL="glfw").returncode == 0
    assert machine.setup(MUJOCO_GL="egl", SAFESWITCH_SKIP_SYSTEM="1").returncode == 0


def test_other_linuxes_are_told_what_is_missing(machine: Machine) -> None:
    for compiler in ("cc", "gcc"):
        machine.command(compiler, "exit 1")
    done = machine.setup()
    assert done.returncode == 1 and "This is no Debian" in done.stderr and "gcc libc6-dev" in done.stderr


def test_macos_needs_no_packages(machine: Machine) -> None:
    machine.virtual_environment()
    machine.command("uname", "echo Darwin")
    assert machine.setup(MUJOCO_GL="").returncode == 0
    for compiler in ("cc", "gcc"):
        machine.command(compiler, "exit 1")
    done = machine.setup()
    assert done.returncode == 1 and "xcode-select --install" in done.stderr


def test_unsuitable_pythons_are_refused(machine: Machine) -> None:
    machine.command("python3", "exit 1")
    done = machine.setup()
    assert done.returncode == 1 and "needs Python 3.11 or 3.12" in done.stderr and "make PYTHON=" in done.stderr
    machine.virtual_environment()
    machine.command("python3.12", f'exec {sys.executable} "$@"')
    assert machine.setup().returncode == 0
    assert machine.setup(PYTHON="python3").returncode == 1


def test_it_installs_again_only_after_a_change(machine: Machine, tmp_path: Path) -> None:
    machine.virtual_environment()
    assert machine.setup().returncode == 0
    (install,) = machine.installs()
    assert install.endswith("-c constraints.txt -e .[dev]")
    assert machine.setup().returncode == 0 and machine.installs() == []
    for name in ("pyproject.toml", "constraints.txt"):
        os.utime(machine.checkout / name)  # a new date is no change
        assert machine.setup().returncode == 0 and machine.installs() == []
        with (machine.checkout / name).open("a") as file:
            file.write("# changed\n")
        assert machine.setup().returncode == 0 and len(machine.installs()) == 1
    assert machine.setup("dev,perf").returncode == 1  # no C++ compiler on this machine
    machine.command("g++", "exit 0")
    assert machine.setup("dev,perf").returncode == 0 and machine.installs()[0].endswith(".[dev,perf]")
    assert machine.setup().returncode == 0 and machine.installs() == []
    assert machine.setup("dev,browser").returncode == 1  # nor a browser for the tests of the report
    for command in ("chromium", "chromedriver"):
        machine.command(command, "exit 0")
    assert machine.setup("dev,browser").returncode == 0 and machine.installs()[0].endswith(".[dev,browser]")


def test_a_failed_install_is_tried_again(machine: Machine) -> None:
    machine.command("python", 'case "$*" in *install*) exit 1;; esac', machine.checkout / ".venv" / "bin")
    assert machine.setup().returncode == 1
    machine.virtual_environment()
    assert machine.setup().returncode == 0 and len(machine.installs()) == 1


def test_a_moved_checkout_gets_a_new_virtual_environment(machine: Machine) -> None:
    machine.virtual_environment()
    assert machine.setup().returncode == 0
    machine.checkout = machine.checkout.rename(machine.checkout.with_name("moved"))
    made = machine.checkout / ".venv" / "made-again"
    machine.command(
        "python3",
        f'case "$*" in "-m venv"*) mkdir -p .venv/bin; echo > {made};'
        f" printf '#!/bin/sh\\n' > .venv/bin/python; chmod +x .venv/bin/python; exit 0;; esac"
        f'; exec {sys.executable} "$@"',
    )
    for tool in ("mkdir", "chmod"):
        (machine.path / tool).symlink_to(str(shutil.which(tool)))
    assert machine.setup().returncode == 0 and made.exists()
