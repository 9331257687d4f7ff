"""Results of stages on disk, found by the hash of all that they depend on.

A stage (demonstrations, training, a handover table, ...) asks for the key of its result. The key covers the stage's
name, its settings, the keys of its inputs, the source of its code and the versions of the libraries it runs on: change
one of them and only what depends on it runs again. ::

    store = Store()
    key = store.key("train", {"epochs": 40}, inputs=[demos], code=["safeswitch_baselines.learners"])
    if not store.has(key):
        with store.writing(key) as folder:
            save_arrays(folder / "arrays.npz", loss=loss)
    loss = store.arrays(key)["loss"]

A result is a folder `<root>/<key>`; it appears in one atomic rename, complete or not at all, whatever kills the
process. Its `key.json` tells a reader what it is. Nothing is pickled.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import importlib.util
import inspect
import json
import os
import platform
import re
import secrets
import shutil
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from safeswitch.files import (
    atomic_write_bytes,
    atomic_write_text,
    jsonable,
    load_arrays,
    load_frame,
    load_json,
    save_arrays,
    save_arrays_compressed,
    save_frame,
    save_json,
)

__all__ = [
    "LIBRARIES",
    "Key",
    "Store",
    "atomic_write_bytes",
    "atomic_write_text",
    "default_root",
    "jsonable",
    "load_arrays",
    "load_frame",
    "load_json",
    "save_arrays",
    "save_arrays_compressed",
    "save_frame",
    "save_json",
]

LIBRARIES = ("casadi", "dm-control", "gymnasium", "mujoco", "numpy", "scipy", "torch")
"""Distributions whose version is part of every key, unless the stage names its own."""

RECIPE = "key.json"
_UNFINISHED = ".writing"
_STALE_SECONDS = 7 * 24 * 3600
"""Unfinished folders of other hosts are taken for dead after this [s]: their processes cannot be asked."""


class Key(str):
    """Key of one result, `<stage>-<24 hex digits>`, carrying the recipe that it is the hash of."""

    recipe: dict[str, Any]

    def __new__(cls, value: str, recipe: dict[str, Any]) -> Key:
        """Make the key `value` of `recipe`."""
        key = super().__new__(cls, value)
        key.recipe = recipe
        return key

    def __getnewargs__(self) -> tuple[str, dict[str, Any]]:  # type: ignore[override]
        """What a copy in a worker process is made from: with its recipe."""
        return str(self), self.recipe


class Store:
    """Results by key under one folder; any number of processes may share it.

    A store reads source files once; after a change of code make a new one, as every run does.

    Args:
        root: the folder. Default: `SAFESWITCH_STORE`, else `.safeswitch/store` in the checkout, else
            `~/.cache/safeswitch/store` for an installed wheel.
    """

    def __init__(self, root: Path | str | None = None) -> None:
        self.root = Path(root).expanduser().absolute() if root is not None else default_root()
        self._code: dict[Any, list[tuple[str, str]]] = {}  # read once: all keys of a run mean the same source

    def __repr__(self) -> str:
        return f"Store({str(self.root)!r})"

    def key(
        self,
        stage: str,
        settings: Any,
        inputs: Iterable[str] = (),
        code: Iterable[str | Path | Callable[..., Any]] = (),
        libraries: Sequence[str] = LIBRARIES,
    ) -> Key:
        """Key of what `stage` makes.

        Args:
            stage: lower-case name, for example ``"train"``.
            settings: whatever the result depends on, as JSON values; dataclasses, tuples, paths and NumPy scalars are
                converted.
            inputs: keys of the results that the stage reads, in the order that matters to it.
            code: what the stage runs: names of modules (a package stands for all its modules), functions or classes
                (their source alone), files or folders (for example MJCF).
            libraries: distributions whose version matters; one that is not installed counts as such.
        """
        if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", stage):
            raise ValueError(f"stage {stage!r} must be lower-case words joined by hyphens, such as 'handover-table'")
        recipe = {
            "stage": stage,
            "settings": jsonable(settings),
            "inputs": [str(key) for key in inputs],
            "code": dict(sorted(pair for each in code for pair in self._hashes(each))),
            "libraries": {name: _version(name) for name in sorted(libraries)},
            "python": platform.python_version(),
        }
        digest = hashlib.sha256(json.dumps(recipe, sort_keys=True).encode()).hexdigest()
        return Key(f"{stage}-{digest[:24]}", recipe)

    def has(self, key: str) -> bool:
        """True if the result is there, complete."""
        return (self.root / key / RECIPE).is_file()

    def folder(self, key: str) -> Path:
        """Where the result is, or will be once its stage has run (`has` tells)."""
        return self.root / key

    def recipe(self, key: str) -> dict[str, Any]:
        """What the result was made from, and when."""
        return load_json(self._existing(key) / RECIPE)

    def arrays(self, key: str, name: str = "arrays.npz") -> dict[str, NDArray[Any]]:
        """Arrays of a result, from the file `name` in its folder."""
        return load_arrays(self._existing(key) / name)

    def keys(self) -> list[str]:
        """Keys of all results, sorted."""
        if not self.root.is_dir():
            return []
        return sorted(each.name for each in self.root.iterdir() if each.name != _UNFINISHED and self.has(each.name))

    @contextlib.contextmanager
    def writing(self, key: str) -> Iterator[Path]:
        """Give an empty folder to fill; it becomes the result of `key` when the block ends without an exception.

        Where two processes make the same result, the first to finish wins and the other's copy is dropped: equal keys
        mean equal results. What killed processes left is removed here.
        """
        if not isinstance(key, Key):
            raise TypeError(f"writing({key!r}) needs the Key that Store.key returned: a plain str has lost its recipe")
        self._sweep()
        folder = self.root / _UNFINISHED / f"{socket.gethostname()}~{os.getpid()}~{secrets.token_hex(6)}"
        folder.mkdir(parents=True)
        started = time.time()
        try:
            yield folder
            made = {"key": str(key), **key.recipe, "seconds": round(time.time() - started, 3), "made": _now()}
            save_json(folder / RECIPE, made)
            self._publish(folder, key)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def size(self) -> int:
        """Bytes of all files in the store, unfinished ones included."""
        return _size(self.root)

    def prune(self, keep: Iterable[str]) -> int:
        """Remove every result whose key is not in `keep`; return the bytes freed."""
        keep, freed = set(keep), 0
        for key in self.keys():
            if key not in keep:
                freed += _size(self.root / key)
                self._discard(self.root / key)
        self._sweep()
        return freed

    def _hashes(self, code: str | Path | Callable[..., Any]) -> list[tuple[str, str]]:
        if code not in self._code:
            self._code[code] = list(_code_hashes(code))
        return self._code[code]

    def _existing(self, key: str) -> Path:
        if not self.has(key):
            raise FileNotFoundError(f"no result {key!r} in {self.root}: run its stage first")
        return self.root / key

    def _publish(self, folder: Path, key: str) -> None:
        """Rename `folder` to the place of `key`; keep what another process put there first."""
        target = self.root / key
        if target.exists() and not self.has(key):  # made by hand or half removed by hand: no result
            self._discard(target)
        try:
            folder.rename(target)
        except OSError:
            if not self.has(key):
                raise

    def _discard(self, folder: Path) -> None:
        """Remove a result in one step as seen by others: out of the way first, its files afterwards."""
        aside = self.root / _UNFINISHED / f"{socket.gethostname()}~{os.getpid()}~{secrets.token_hex(6)}"
        aside.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):  # another process was faster
            folder.rename(aside)
        shutil.rmtree(aside, ignore_errors=True)

    def _sweep(self) -> None:
        """Remove unfinished folders whose process is gone."""
        unfinished = self.root / _UNFINISHED
        for folder in list(unfinished.iterdir()) if unfinished.is_dir() else ():
            if _is_dead(folder):
                shutil.rmtree(folder, ignore_errors=True)


def default_root() -> Path:
    """Where the store is unless told otherwise."""
    if root := os.environ.get("SAFESWITCH_STORE"):
        return Path(root).expanduser().absolute()
    checkout = Path(__file__).resolve().parents[2]
    if (checkout / "pyproject.toml").is_file() and (checkout / "benchmark").is_dir():
        return checkout / ".safeswitch" / "store"
    return Path.home() / ".cache" / "safeswitch" / "store"


def _code_hashes(code: str | Path | Callable[..., Any]) -> Iterator[tuple[str, str]]:
    """Pairs (readable name, hash of the source) of one entry of `code`."""
    if isinstance(code, Path):
        if not code.exists():
            raise FileNotFoundError(f"code names {code}, which does not exist")
        for file in _files(code):
            yield (Path(code.name) / file.relative_to(code)).as_posix(), _sha(file.read_bytes())
    elif isinstance(code, str):
        origin = _module_path(code)
        for file in module_files(code):
            inside = f"/{file.relative_to(origin.parent).as_posix()}" if origin.name == "__init__.py" else ""
            yield f"{code}{inside}", _sha(file.read_bytes())
    else:
        yield f"{code.__module__}:{code.__qualname__}", _sha(inspect.getsource(code).encode())


def module_files(name: str) -> list[Path]:
    """Source of a module, or of all modules of a package."""
    origin = _module_path(name)
    if origin.name != "__init__.py":
        return [origin]
    return [each for each in _files(origin.parent) if each.suffix == ".py"]


def _module_path(name: str) -> Path:
    """Source file of a module, which is not imported for it (its parent packages are)."""
    try:
        spec = importlib.util.find_spec(name)
    except ModuleNotFoundError:
        spec = None
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        raise ModuleNotFoundError(f"code names the module {name!r}, which has no Python source on sys.path", name=name)
    return Path(spec.origin)


def _files(path: Path) -> list[Path]:
    """`path` itself if it is a file, else every file below it but caches, sorted."""
    if path.is_file():
        return [path]
    return sorted(each for each in path.rglob("*") if each.is_file() and "__pycache__" not in each.parts)


def _sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:24]


@cache
def _version(distribution: str) -> str:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())


def _size(folder: Path) -> int:
    total = 0
    for file in folder.rglob("*"):
        with contextlib.suppress(FileNotFoundError):  # just removed by another process
            total += file.stat().st_size if file.is_file() else 0
    return total


def _is_dead(unfinished: Path) -> bool:
    """True if the process that made the folder, named in the folder's name, no longer runs."""
    host, _, rest = unfinished.name.rpartition("~")[0].partition("~")
    if host == socket.gethostname() and rest.isdigit() and sys.platform != "win32":
        try:
            os.kill(int(rest), 0)
        except ProcessLookupError:
            return True
        except PermissionError:  # it runs, as another user
            return False
        return False
    with contextlib.suppress(FileNotFoundError):
        return time.time() - unfinished.stat().st_mtime > _STALE_SECONDS
    return False
