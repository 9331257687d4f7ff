"""The doctor finds what is broken, says so with a remedy, and survives whatever a probe does."""

from __future__ import annotations

import os
import sys
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from safeswitch import doctor
from safeswitch.doctor import Check
from safeswitch.tasks.opengl import describe_renderer


def script(path: Path, body: str) -> str:
    path.write_text(f"#!/bin/sh\n{body}\n")
    path.chmod(0o755)
    return str(path)


def test_this_machine_can_run_the_suite() -> None:
    checks = doctor.run_checks()
    assert [check.name for check in checks] == [
        "Python",
        "MuJoCo and dm-control",
        "rendering",
        "C compiler",
        "CasADi",
        "torch",
        "Minari",
        "disk",
    ]
    assert all(check.detail for check in checks)
    assert [check for check in checks if not check.ok and not check.remedy] == []
    # Python packages were installed by whoever runs the tests; drivers, compiler and disk are the machine's.
    assert [check for check in checks if not check.ok and check.name not in ("rendering", "C compiler", "disk")] == []


@pytest.mark.parametrize("version", [(3, 10, 4), (3, 13, 0), (4, 0, 0)])
def test_unsupported_python(monkeypatch: pytest.MonkeyPatch, version: tuple[int, int, int]) -> None:
    monkeypatch.setattr(sys, "version_info", version)
    check = doctor.check_python()
    assert not check.ok and ">= 3.11, < 3.13" in check.remedy


@pytest.mark.parametrize(
    ("probe", "detail"),
    [
        ("raise AttributeError('flex_vertedge')", "AttributeError: flex_vertedge"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "crashed with signal 11"),
        ("import sys; sys.exit(3)", "ended with code 3"),
        ("import time; time.sleep(60)", "no answer within 0 s"),
    ],
)
def test_a_probe_that_fails_crashes_or_hangs_is_a_failed_check(
    monkeypatch: pytest.MonkeyPatch, probe: str, detail: str
) -> None:
    monkeypatch.setattr(doctor, "_PAIR", probe)
    if "sleep" in probe:
        monkeypatch.setattr(doctor, "TIMEOUT", 0.2)
    check = doctor.check_pair()
    assert not check.ok and detail in check.detail
    assert "mujoco >= 3.17 and < 4" in check.remedy


def test_a_driver_that_crashes_at_exit_has_still_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        doctor,
        "_RENDER",
        """import os; print('{"detail": "llvmpipe", "renderer": "llvmpipe"}', flush=True); os.abort()""",
    )
    check = doctor.check_rendering()
    assert check.ok and "software" in check.detail
    monkeypatch.setattr(doctor, "_RENDER", """print('{"detail": "NVIDIA A100", "renderer": "NVIDIA A100"}')""")
    assert doctor.check_rendering().detail == "NVIDIA A100 (a GPU)"


@pytest.mark.rendering
def test_what_draws_is_named() -> None:
    found = describe_renderer()
    detail = doctor.check_rendering().detail
    assert all(each in detail for each in (found.backend, found.renderer, found.vendor, found.version, "frames/s"))
    assert ("software" in detail) == found.software


@pytest.mark.skipif(sys.platform != "linux", reason="the Debian remedy")
def test_rendering_that_fails_names_the_debian_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "no-such-backend")
    check = doctor.check_rendering()
    assert not check.ok and "MUJOCO_GL=no-such-backend" in check.detail
    assert doctor.REMEDY in check.remedy and doctor.ALTERNATIVE in check.remedy


def test_a_compiler_that_only_pretends_is_found_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    assert "neither gcc, cc nor clang" in doctor.check_compiler().detail
    script(tmp_path / "gcc", "exit 0")  # succeeds and makes nothing
    script(tmp_path / "cc", "echo 'math.h: fatal error: no such file' >&2; exit 1")
    check = doctor.check_compiler()
    assert not check.ok and "probe.so" in check.detail and "fatal error: no such file" in check.detail
    assert "gcc libc6-dev" in check.remedy or "xcode-select" in check.remedy


@pytest.mark.skipif(os.name == "nt", reason="POSIX shell")
def test_a_compiler_that_miscomputes_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_C_SOURCE", "double probe(double x) { return x; }\n")
    assert "sqrt(9) gave 9.0" in doctor.check_compiler().detail or doctor.shutil.which("cc") is None


def test_disk(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SAFESWITCH_STORE", str(tmp_path / "not" / "yet"))
    monkeypatch.setattr(doctor, "DISK_GIB", 0.0)
    assert doctor.check_disk().ok and not (tmp_path / "not").exists()
    monkeypatch.setattr(doctor, "DISK_GIB", 1e9)
    check = doctor.check_disk()
    assert not check.ok and "SAFESWITCH_STORE" in check.remedy


def test_report_and_exit_code(monkeypatch: pytest.MonkeyPatch) -> None:
    remedy = "on Debian, as root: apt-get install -y libegl1 libgl1-mesa-dri libopengl0; and leave it unset " + "x" * 60
    good, bad = Check("Python", True, "3.11.7"), Check("rendering", False, "no EGL [at all]", remedy)
    for checks, code in (([good], 0), ([good, bad], 1)):
        monkeypatch.setattr(doctor, "CHECKS", [lambda check=check: check for check in checks])
        console = Console(file=StringIO(), width=60)
        assert doctor.main(console) == code
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "FAILED" in text and "no EGL [at all]" in text
    assert remedy in text  # on one line, whatever the width: it is there to be copied
