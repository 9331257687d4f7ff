"""crocoddyl's SolverBoxDDP on a problem of the expert's, compiled from `perf_crocoddyl.cpp` and generated C.

Its library is used as pip installs it: ``pip install crocoddyl cmeel-eigen``.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import shutil
import subprocess
import tempfile
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from safeswitch.expert.codegen import FLAGS, find_compiler, source
from safeswitch.expert.ddp import Problem
from safeswitch.expert.graph import expanded

Array = NDArray[np.float64]

INSTALL = "pip install crocoddyl==3.2.1 cmeel-eigen"


class UnavailableError(RuntimeError):
    """The comparison cannot run here; the message says what to install."""


class Crocoddyl:
    """crocoddyl's SolverBoxDDP of a `Problem`, through `perf_crocoddyl.cpp`."""

    def __init__(self, problem: Problem) -> None:
        self._nx, self._nu = problem.nx, problem.nu
        with tempfile.TemporaryDirectory(prefix="safeswitch-perf-") as folder:  # a loaded library needs no file
            self._library = ctypes.CDLL(str(compile_rival(problem, Path(folder))))
        self._library.croco_make.restype = ctypes.c_void_p
        lo, hi = np.array(problem.u_lo), np.array(problem.u_hi)
        self._handle = ctypes.c_void_p(
            self._library.croco_make(problem.nx, problem.nu, problem.np, problem.horizon, _pointer(lo), _pointer(hi))
        )

    def solve(self, parameters: Array, x: Array, u: Array, iterations: int, stop: float) -> tuple[float, int, float]:
        """(cost, iterations made, seconds) from the feasible trajectory x (N + 1, nx), u (N, nu)."""
        parameters, x, u, info = parameters.copy(), x.copy(), u.copy(), np.zeros(3)
        arguments = (_pointer(parameters), _pointer(x), _pointer(u))
        self._library.croco_solve(self._handle, *arguments, iterations, ctypes.c_double(stop), _pointer(info))
        return float(info[0]), int(info[1]), float(info[2])

    def __del__(self) -> None:
        if hasattr(self, "_handle"):
            self._library.croco_free(self._handle)


def _pointer(array: Array) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def compile_rival(problem: Problem, folder: Path) -> Path:
    """Compile the C++ program with the generated C code into a library in `folder`."""
    compiler, plain = shutil.which("g++"), find_compiler()
    if compiler is None or plain is None:
        raise UnavailableError("no g++ on the PATH (on Debian or Ubuntu: apt-get install -y g++)")
    prefix = crocoddyl_prefix()
    flags = [flag for flag in FLAGS if flag != "-shared"]
    objects = []
    for function in action_functions(problem):
        c_file, built = folder / f"{function.name()}.c", folder / f"{function.name()}.o"
        c_file.write_text(source(function))
        _compile([plain, *flags, "-c", str(c_file), "-o", str(built)])
        objects.append(str(built))
    # The wheel is built for the plain architecture, and Eigen's allocator depends on it: with -march=native here,
    # matrices would be allocated one way and freed the other. This file only passes pointers on;
    # the arithmetic is in `objects`.
    cpp = [compiler, "-std=c++17", "-O3", "-DNDEBUG", "-fPIC", "-shared"]
    cpp += [f"-I{prefix / 'include'}", f"-I{prefix / 'include' / 'eigen3'}"]
    library = folder / "libperf_crocoddyl.so"
    program = Path(__file__).with_name("perf_crocoddyl.cpp")
    link = [f"-L{prefix / 'lib'}", "-lcrocoddyl", f"-Wl,--disable-new-dtags,-rpath,{prefix / 'lib'}"]
    _compile([*cpp, str(program), *objects, *link, "-o", str(library)])
    return library


def crocoddyl_prefix() -> Path:
    """Where pip put crocoddyl's and Eigen's headers and libraries."""
    try:
        distribution = importlib.metadata.distribution("libcrocoddyl")
    except importlib.metadata.PackageNotFoundError:
        raise UnavailableError(f"crocoddyl is not installed ({INSTALL})") from None
    prefix = Path(str(distribution.locate_file("cmeel.prefix")))
    if not (prefix / "include" / "eigen3" / "Eigen" / "Core").is_file():
        raise UnavailableError(f"Eigen's headers are not installed ({INSTALL})")
    return prefix


def _compile(command: list[str]) -> None:
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    if answer.returncode != 0:
        raise UnavailableError(f"{command[0]} failed: {answer.stderr.strip()[-800:]}")


def action_functions(problem: Problem) -> list[ca.Function]:
    """What crocoddyl's action model calls: dynamics, cost, and their derivatives (Gauss-Newton Hessians)."""
    x, u, p = ca.MX.sym("x", problem.nx), ca.MX.sym("u", problem.nu), ca.MX.sym("p", problem.np)
    f, r, end = problem.dynamics(x, u, p), problem.residual(x, u, p), problem.terminal_residual(x, p)
    rx, ru, end_x = ca.jacobian(r, x), ca.jacobian(r, u), ca.jacobian(end, x)
    slopes = [ca.jacobian(f, x), ca.jacobian(f, u), rx.T @ r, ru.T @ r]
    return [
        expanded("perf_calc", [x, u, p], [f, 0.5 * ca.sumsqr(r)]),
        expanded("perf_diff", [x, u, p], [*slopes, rx.T @ rx, ru.T @ ru, rx.T @ ru]),
        expanded("perf_end_calc", [x, p], [0.5 * ca.sumsqr(end)]),
        expanded("perf_end_diff", [x, p], [end_x.T @ end, end_x.T @ end_x]),
    ]
