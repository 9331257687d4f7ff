"""Files that a reader sees whole or not at all, with the same bytes for the same content, and without pickle."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import secrets
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    import pandas as pd


def jsonable(value: Any, where: str = "settings", nan_as_null: bool = False) -> Any:
    """`value` as plain JSON values: dataclasses, mappings, tuples, paths, NumPy scalars and arrays are converted.

    Args:
        value: what to convert.
        where: names the place in error messages.
        nan_as_null: write NaN, which JSON has not, as null; otherwise it is an error, as infinity always is.
    """
    if value is None or isinstance(value, bool | str):
        return value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, np.generic | np.ndarray):
        return jsonable(value.tolist(), where, nan_as_null)
    if isinstance(value, int):  # also IntEnum
        return int(value)
    if isinstance(value, float):
        if nan_as_null and math.isnan(value):
            return None
        if not math.isfinite(value):
            raise ValueError(f"{where} is {value}: JSON has no such number, use None or a string")
        return float(value)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        if bad := [name for name in value if not isinstance(name, str)]:
            raise TypeError(f"{where} has the name {bad[0]!r} of type {type(bad[0]).__name__}: JSON names are str")
        return {str(name): jsonable(each, f"{where}[{name!r}]", nan_as_null) for name, each in value.items()}
    if isinstance(value, list | tuple | range):
        return [jsonable(each, f"{where}[{index}]", nan_as_null) for index, each in enumerate(value)]
    raise TypeError(f"{where} is of type {type(value).__name__}, which JSON cannot hold")


def save_arrays(path: Path | str, /, **arrays: ArrayLike) -> None:
    """Write `arrays` to one .npz file: atomic, no pickle (so no object arrays), the same bytes for the same arrays."""
    _write_npz(Path(path), arrays, zipfile.ZIP_STORED)


def save_arrays_compressed(path: Path | str, /, **arrays: ArrayLike) -> None:
    """As `save_arrays`, smaller and slower: for files that are kept or committed."""
    _write_npz(Path(path), arrays, zipfile.ZIP_DEFLATED)


def load_arrays(path: Path | str) -> dict[str, NDArray[Any]]:
    """Read every array of an .npz file."""
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def save_frame(path: Path | str, frame: pd.DataFrame) -> None:
    """Write a data frame to one .npz file, an array a column; the index is not kept.

    Columns may be bool, int, float or text. Text must not have missing values.
    """
    columns: dict[str, NDArray[Any]] = {}
    for name in frame.columns:
        values = frame[name]
        if values.dtype.kind not in "biuf":
            if bad := [each for each in values if not isinstance(each, str)]:
                raise TypeError(f"column {name!r} must hold numbers or text alone, it has {bad[0]!r}")
            columns[str(name)] = np.array(values.tolist(), dtype=np.str_)
        else:
            columns[str(name)] = values.to_numpy()
    save_arrays(path, **columns)


def load_frame(path: Path | str) -> pd.DataFrame:
    """Read a data frame that `save_frame` wrote, with its columns in order."""
    import pandas as pd

    return pd.DataFrame(
        {name: array.tolist() if array.dtype.kind == "U" else array for name, array in load_arrays(path).items()}
    )


def save_json(path: Path | str, value: Any) -> None:
    """Write `value` as indented JSON, atomically; NaN becomes null, other values are converted as `jsonable` does."""
    plain = jsonable(value, Path(path).name, nan_as_null=True)
    atomic_write_text(path, json.dumps(plain, indent=2, ensure_ascii=False) + "\n")


def load_json(path: Path | str) -> Any:
    """Read a JSON file."""
    return json.loads(Path(path).read_text(encoding="utf-8"))


def atomic_write_text(path: Path | str, text: str) -> None:
    """Write `text` as UTF-8, as is (no newline conversion); a reader sees the old file or the new one, never a part."""
    atomic_write_bytes(path, text.encode())


def atomic_write_bytes(path: Path | str, data: bytes) -> None:
    """Write `data`; a reader sees the old file or the new one, never a part."""
    with _replacing(Path(path)) as temporary:
        temporary.write_bytes(data)


def _write_npz(path: Path, arrays: Mapping[str, ArrayLike], method: int) -> None:
    with _replacing(path) as temporary, zipfile.ZipFile(temporary, "w", method) as archive:
        for name, array in arrays.items():
            # np.savez stamps the time of writing on every member; ZipInfo alone has a fixed date.
            member = zipfile.ZipInfo(f"{name}.npy")
            member.compress_type = method
            member.external_attr = 0o644 << 16
            with archive.open(member, "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path` that replaces it when the block ends without an exception."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
