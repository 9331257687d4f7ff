"""Checks the machine: everything the suite stands on is used once, for real, and each failure comes with its remedy.

What may crash or hang (OpenGL drivers, native libraries) runs in a process of its own: a machine on which the suite
cannot even be imported still gets its diagnosis.
"""

from __future__ import annotations

import ctypes
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from safeswitch.store import default_root
from safeswitch.tasks.opengl import ALTERNATIVE, REMEDY, is_software

PYTHONS = ((3, 11), (3, 13))
"""First supported version and first unsupported one."""

DISK_GIB = 5.0
"""Free space that a full run may need [GiB]."""

TIMEOUT = 120.0
"""A check that takes longer hangs [s]."""

REINSTALL = "make setup (or: pip install -c constraints.txt -e .)"


@dataclass(frozen=True)
class Check:
    """What one check found.

    Attributes:
        name: what was checked.
        ok: True if it works.
        detail: what was found: versions, numbers, or the error.
        remedy: what to do about it; empty if nothing.
    """

    name: str
    ok: bool
    detail: str
    remedy: str = ""


# Every probe prints one JSON object as its last line: {"detail": ...}, or raises.
_PAIR = """
import json, mujoco
from dm_control import mjcf
root = mjcf.RootElement()
body = root.worldbody.add("body", name="bob", pos=[0, 0, 1])
body.add("freejoint")
body.add("geom", type="sphere", size=[0.1], mass=1)
model = mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets())
data = mujoco.MjData(model)
while data.time < 0.1:
    mujoco.mj_step(model, data)
fallen = 1 - data.qpos[2]
assert abs(fallen - 0.5 * 9.81 * data.time**2) < 2e-2, f"a ball fell {fallen} m in {data.time} s"
physics = mjcf.Physics.from_mjcf_model(root)
physics.step()
print(json.dumps({"detail": "compose, compile and step agree"}))
"""

_RENDER = """
import json, time
from safeswitch.tasks.rendering import Renderer, describe_renderer
import mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 -3 3' dir='0 1 -1'/><geom type='box' size='.5 .5 .5' rgba='1 0 0 1'/>"
    "<camera name='c' pos='0 -3 0' xyaxes='1 0 0 0 0 1'/></worldbody></mujoco>"
)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = Renderer(model, 64, 64, "c", fast=True)
frame = renderer.render(model, data).astype(int)
centre, corner = frame[32, 32], frame[1, 1]
assert centre[0] > 50 + max(centre[1:]) and max(corner) < 20, f"a red box was drawn as {centre} on {corner}"
start, frames = time.perf_counter(), 200
for _ in range(frames):
    renderer.render(model, data)
rate = frames / (time.perf_counter() - start)
renderer.close()
found = describe_renderer()
detail = f"{found.backend}: {found.renderer}, {found.vendor}, OpenGL {found.version}, {rate:.0f} frames/s at 64 x 64"
print(json.dumps({"detail": detail, "renderer": found.renderer}))
"""

_TORCH = """
import json, torch
layer = torch.nn.Linear(3, 1)
loss = (layer(torch.ones(4, 3)) - 1).square().mean()
loss.backward()
assert layer.weight.grad.isfinite().all()
cuda = f"CUDA: {torch.cuda.get_device_name(0)}" if torch.cuda.is_available() else "no CUDA (not needed)"
print(json.dumps({"detail": f"{torch.__version__}, {torch.get_num_threads()} threads, {cuda}"}))
"""

_CASADI = """
import json, casadi
x = casadi.SX.sym("x", 2)
gradient = casadi.Function("g", [x], [casadi.gradient(casadi.dot(x, x), x)])
assert gradient([1, 2]).full().ravel().tolist() == [2, 4]
print(json.dumps({"detail": casadi.__version__}))
"""

_MINARI = """
import json, os, sys, tempfile
with tempfile.TemporaryDirectory() as folder:
    os.environ["MINARI_DATASETS_PATH"] = folder
    import gymnasium, minari, numpy as np
    from minari.data_collector.episode_buffer import EpisodeBuffer
    box = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    episode = EpisodeBuffer(
        observations=np.zeros((4, 2), np.float32), actions=np.ones((3, 2), np.float32), rewards=[0.0] * 3,
        terminations=[False] * 3, truncations=[False, False, True], infos={},
    )
    minari.create_dataset_from_buffers(
        "doctor/probe-v0", buffer=[episode], observation_space=box, action_space=box, algorithm_name="none",
        author="none", author_email="none", code_permalink="none", description="none",
    )
    back = next(minari.load_dataset("doctor/probe-v0").iterate_episodes())
    assert (back.actions == 1).all() and back.observations.shape == (4, 2)
print(json.dumps({"detail": f"{minari.__version__}, a dataset written and read back"}))
"""

_C_SOURCE = "#include <math.h>\ndouble probe(double x) { return sqrt(x); }\n"


def run_checks() -> list[Check]:
    """Run every check; a few at a time, since most of them wait for a process."""
    with ThreadPoolExecutor(max_workers=3) as pool:
        return list(pool.map(lambda check: check(), CHECKS))


def print_checks(checks: list[Check], console: Console | None = None) -> None:
    """Print a table of the checks, then the remedy of each that failed, whole and ready to be copied."""
    console = console or Console()
    table = Table(box=None, pad_edge=False)
    for heading in ("", "check", "found"):
        table.add_column(heading, overflow="fold")
    for check in checks:
        table.add_row(
            Text("ok", "green") if check.ok else Text("FAILED", "bold red"), Text(check.name), Text(check.detail)
        )
    console.print(table)
    for check in checks:
        if check.remedy:
            console.print(Text(f"\n{check.name}: ", "bold"), Text(check.remedy), sep="", soft_wrap=True)


def main(console: Console | None = None) -> int:
    """Check, print and return the exit code: 0 if all is well, else 1."""
    checks = run_checks()
    print_checks(checks, console)
    return 0 if all(check.ok for check in checks) else 1


def check_python() -> Check:
    """Python's version is one that all dependencies have wheels for."""
    first, last = (".".join(map(str, each)) for each in PYTHONS)
    ok = PYTHONS[0] <= sys.version_info[:2] < PYTHONS[1]
    remedy = f"use Python >= {first}, < {last}: make clean, then make PYTHON=/path/to/python{first} setup"
    return Check("Python", ok, f"{platform.python_version()}, {sys.executable}", "" if ok else remedy)


def check_pair() -> Check:
    """MuJoCo and dm-control fit each other: a model is composed, compiled and stepped by both."""
    name = "MuJoCo and dm-control"
    versions = f"mujoco {_version('mujoco')}, dm-control {_version('dm-control')}"
    # No OpenGL here: a machine that cannot render must not look like one with a wrong pair.
    ok, detail, _ = _probe(_PAIR, MUJOCO_GL="disable")
    remedy = f"dm-control 1.0.50 needs mujoco >= 3.17 and < 4: {REINSTALL}"
    return Check(name, ok, f"{versions}: {detail}", "" if ok else remedy)


def check_rendering() -> Check:
    """A frame is rendered off screen and has the right colours in the right places; says what has drawn it."""
    ok, detail, found = _probe(_RENDER)
    if ok:
        drawn_by = "software, no GPU needed" if is_software(found.get("renderer", "")) else "a GPU"
        return Check("rendering", True, f"{detail} ({drawn_by})")
    detail = f"MUJOCO_GL={os.environ.get('MUJOCO_GL', '')}: {detail}"
    if sys.platform == "linux":
        remedy = (
            f"on Debian, as root: {REMEDY}; and leave MUJOCO_GL unset, or set it to egl. "
            f"Without EGL: {ALTERNATIVE}, and MUJOCO_GL=osmesa"
        )
    else:
        remedy = "unset MUJOCO_GL, and run in a session with a display"
    return Check("rendering", False, detail, remedy)


def check_compiler() -> Check:
    """The C compiler builds a shared library that can be loaded and called, as the expert's solver is."""
    candidates = [os.environ.get("CC", ""), "gcc", "cc", "clang"]
    errors = []
    for compiler in filter(None, map(shutil.which, filter(None, candidates))):
        error = _compile(compiler)
        if error is None:
            first = _output([compiler, "--version"]).partition("\n")[0]
            return Check("C compiler", True, f"{first}, {compiler}")
        errors.append(f"{compiler}: {error}")
    linux = sys.platform == "linux"
    remedy = "on Debian, as root: apt-get install -y gcc libc6-dev" if linux else "xcode-select --install"
    detail = "; ".join(errors) or "neither gcc, cc nor clang found"
    return Check("C compiler", False, detail, f"{remedy} (without it the expert works, but some ten times slower)")


def check_casadi() -> Check:
    """CasADi differentiates."""
    ok, detail, _ = _probe(_CASADI)
    return Check("CasADi", ok, detail, "" if ok else REINSTALL)


def check_torch() -> Check:
    """Torch trains."""
    ok, detail, _ = _probe(_TORCH)
    return Check("torch", ok, detail, "" if ok else REINSTALL)


def check_minari() -> Check:
    """Minari writes a dataset and reads it back."""
    ok, detail, _ = _probe(_MINARI)
    return Check("Minari", ok, detail, "" if ok else REINSTALL)


def check_disk() -> Check:
    """The store's disk has room, and the store can be written to."""
    root = default_root()
    existing = next(each for each in (root, *root.parents) if each.exists())
    free = shutil.disk_usage(existing).free / 2**30
    detail = f"{free:.1f} GiB free for {root}"
    remedy = f"free {DISK_GIB:.0f} GiB, or set SAFESWITCH_STORE to a folder on another disk"
    if not os.access(existing, os.W_OK):
        return Check("disk", False, f"{existing} cannot be written to", "set SAFESWITCH_STORE to a folder of yours")
    return Check("disk", free >= DISK_GIB, detail, "" if free >= DISK_GIB else remedy)


CHECKS: tuple[Callable[[], Check], ...] = (
    check_python,
    check_pair,
    check_rendering,
    check_compiler,
    check_casadi,
    check_torch,
    check_minari,
    check_disk,
)


def _probe(script: str, **environment: str) -> tuple[bool, str, dict[str, str]]:
    """Run `script` in a process of its own: whether it worked, what it found or the error, and all it reported."""
    command = [sys.executable, "-c", script]
    try:
        done = subprocess.run(
            command, env={**os.environ, **environment}, capture_output=True, text=True, timeout=TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        return False, f"no answer within {TIMEOUT:.0f} s", {}
    lines = done.stdout.strip().splitlines()
    # Judged by what it printed: some OpenGL drivers crash at exit, after the work is done.
    if lines and lines[-1].startswith("{"):
        found = json.loads(lines[-1])
        return True, found["detail"], found
    if done.returncode < 0:
        return False, f"the process crashed with signal {-done.returncode}", {}
    errors = done.stderr.strip().splitlines()
    return False, errors[-1].strip() if errors else f"the process ended with code {done.returncode}", {}


def _compile(compiler: str) -> str | None:
    """Build, load and call a library; the error, or None if it worked."""
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder, "probe.c"), Path(folder, "probe.so")
        source.write_text(_C_SOURCE)
        command = [compiler, "-O3", "-shared", "-fPIC", "-o", str(library), str(source), "-lm"]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=False)
            if done.returncode != 0:
                lines = done.stderr.strip().splitlines()
                return next((line for line in lines if "error" in line), f"exit code {done.returncode}")
            function = ctypes.CDLL(str(library)).probe
        except (OSError, subprocess.TimeoutExpired) as error:
            return str(error)
        function.argtypes, function.restype = [ctypes.c_double], ctypes.c_double
        return None if function(9.0) == 3.0 else f"sqrt(9) gave {function(9.0)}"


def _output(command: list[str]) -> str:
    return subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=False).stdout.strip()


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"


if __name__ == "__main__":
    sys.exit(main())
