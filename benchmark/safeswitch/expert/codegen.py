"""Turn a CasADi function into a compiled library and call it without allocating anything.

`build(function)` writes the function as C, compiles it once per machine into a cache folder and returns the
library's function; `Kernel(function)` binds input and output arrays to it, so that a call costs about a microsecond on
top of the work itself. Without a C compiler CasADi's virtual machine runs the same expressions, about
nine times slower.

The cache key is the hash of the generated source, the compiler's version, the flags and the processor (the code is
built with ``-march=native``). The folder is ``$SAFESWITCH_CACHE``, or ``~/.cache/safeswitch``.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
import warnings
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray

# No -ffast-math: it gains nothing here, breaks isfinite, and a library linked with it switches the whole process to
# flush-to-zero. -ffp-contract=off keeps the compiled code equal to CasADi's virtual machine to the last bits, which
# matters because a line search amplifies a rounding difference.
FLAGS: tuple[str, ...] = ("-O3", "-march=native", "-fno-math-errno", "-ffp-contract=off", "-fno-semantic-interposition")
FLAGS += ("-fPIC", "-shared")

COMPILER_HINT = "on Debian or Ubuntu: apt-get install -y gcc libc6-dev"


class CompileError(RuntimeError):
    """The C compiler was found but did not produce a library."""


def cache_dir() -> Path:
    """Folder of the compiled libraries: ``$SAFESWITCH_CACHE`` or ``~/.cache/safeswitch``."""
    root = os.environ.get("SAFESWITCH_CACHE")
    return Path(root).expanduser() if root else Path.home() / ".cache" / "safeswitch"


def find_compiler() -> str | None:
    """Path of the C compiler: ``$CC`` if set, else the first of gcc, cc and clang on the PATH; None without one.

    ``SAFESWITCH_COMPILER=none`` (or ``CC=none``) forces the virtual machine.
    """
    wished = os.environ.get("SAFESWITCH_COMPILER") or os.environ.get("CC")
    candidates = (wished,) if wished else ("gcc", "cc", "clang")
    return next((path for name in candidates if (path := shutil.which(name)) is not None), None)


@cache
def compiler_version(compiler: str) -> str:
    """First line of ``<compiler> --version``."""
    answer = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False, timeout=60)
    return (answer.stdout or answer.stderr).strip().partition("\n")[0]


@cache
def processor() -> str:
    """What -march=native depends on: the processor's model and instruction sets."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    wanted = ("vendor_id", "cpu family", "model\t", "model name", "flags", "Features", "CPU part")
    seen = {line for line in lines if line.startswith(wanted)}
    return platform.machine() + "\n" + "\n".join(sorted(seen))


def source(function: ca.Function) -> str:
    """C source of `function`."""
    generator = ca.CodeGenerator(f"{function.name()}.c", {"with_header": False, "verbose": False})
    generator.add(function)
    return str(generator.dump())


def library(function: ca.Function, compiler: str) -> Path:
    """Compiled library of `function`, from the cache if it is there."""
    code = source(function)
    parts = (code, compiler_version(compiler), " ".join(FLAGS), processor())
    key = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:20]
    folder = cache_dir()
    path = folder / f"{function.name()}-{key}.so"
    if path.exists():
        return path
    folder.mkdir(parents=True, exist_ok=True)
    # Built aside and renamed: another process sees either no library or a whole one.
    with tempfile.TemporaryDirectory(dir=folder, prefix=".build-") as scratch:
        c_file, built = Path(scratch) / f"{function.name()}.c", Path(scratch) / path.name
        c_file.write_text(code)
        command = [compiler, *FLAGS, str(c_file), "-o", str(built), "-lm"]
        answer = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
        if answer.returncode != 0:
            raise CompileError(f"{compiler} failed on {function.name()}: {answer.stderr.strip()[-500:]}")
        os.replace(built, path)
    return path


@cache
def _warn_once(message: str) -> None:
    warnings.warn(message, RuntimeWarning, stacklevel=4)


def build(function: ca.Function) -> ca.Function:
    """Compiled twin of `function` (same name, inputs and outputs); `function` itself when it cannot be compiled."""
    compiler = find_compiler()
    if compiler is None:
        _warn_once(f"no C compiler found: CasADi's virtual machine is used, about 9x slower ({COMPILER_HINT})")
        return function
    try:
        return ca.external(function.name(), str(library(function, compiler)))
    except (CompileError, OSError, subprocess.SubprocessError, RuntimeError) as error:
        _warn_once(f"compilation failed: CasADi's virtual machine is used, about 9x slower ({error})")
        return function


def is_compiled(function: ca.Function) -> bool:
    """Whether `function` runs compiled code rather than CasADi's virtual machine."""
    return bool(function.class_name() in ("GenericExternal", "External"))


class Kernel:
    """A CasADi function bound to its own input and output arrays.

    Write into ``inputs[name]``, call the object, read ``outputs[name]``; nothing is allocated or converted. Arrays are
    C-contiguous and *transposed*: a CasADi (rows, columns) matrix, stored by columns, is an array (columns, rows), and
    a column vector is an array (rows,). All arguments must be dense. Not safe for use by several threads at once.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self.inputs = {name: _array(function.sparsity_in(i)) for i, name in enumerate(map(str, function.name_in()))}
        self.outputs = {name: _array(function.sparsity_out(i)) for i, name in enumerate(map(str, function.name_out()))}
        # The buffer object must be kept: `_trigger` points into it.
        self._buffer, self._trigger = function.buffer()
        for i, array in enumerate(self.inputs.values()):
            self._buffer.set_arg(i, array.data)
        for i, array in enumerate(self.outputs.values()):
            self._buffer.set_res(i, array.data)

    def __call__(self) -> None:
        """Evaluate `outputs` from `inputs`."""
        self._trigger()


def _array(sparsity: ca.Sparsity) -> NDArray[np.float64]:
    if not sparsity.is_dense():
        raise ValueError("Kernel needs dense arguments; wrap the expression in casadi.densify")
    rows, columns = sparsity.shape
    return np.zeros(rows) if columns == 1 else np.zeros((columns, rows))
