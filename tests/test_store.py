"""Laws of the store: keys change with what they depend on and with nothing else; results are whole or not there."""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
import textwrap
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safeswitch import store as store_module
from safeswitch.store import (
    Key,
    Store,
    atomic_write_text,
    default_root,
    jsonable,
    load_arrays,
    load_frame,
    load_json,
    save_arrays,
    save_arrays_compressed,
    save_frame,
    save_json,
)


@dataclass(frozen=True)
class Config:
    width: int = 256
    dropout: float = 0.1
    angles: tuple[int, ...] = (2,)


def double(x: float) -> float:
    return 2 * x


def triple(x: float) -> float:
    return 3 * x


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


def fill(store: Store, key: str, value: float) -> None:
    with store.writing(key) as folder:
        save_arrays(folder / "arrays.npz", value=value)


# ---- keys


def test_key_is_a_function_of_everything_it_covers(store: Store) -> None:
    base = {"stage": "train", "settings": {"epochs": 4, "config": Config()}, "inputs": ["demos-1"], "code": [double]}
    key = store.key(**base)
    assert key == store.key(**base) == Store("/elsewhere").key(**base)
    assert key.startswith("train-") and Path(key).name == key
    changes = [
        {"stage": "training"},
        {"settings": {"epochs": 5, "config": Config()}},
        {"settings": {"epochs": 4, "config": Config(dropout=0.2)}},
        {"inputs": ["demos-2"]},
        {"inputs": ["demos-1", "demos-1"]},
        {"code": [triple]},
        {"code": [double, triple]},
        {"libraries": ["numpy"]},
    ]
    assert len({key, *(store.key(**{**base, **change}) for change in changes)}) == len(changes) + 1


def test_key_ignores_order_of_names_and_kinds_of_sequences(store: Store) -> None:
    one = store.key("train", {"a": 1, "b": (1, 2)}, code=[double, triple], libraries=["numpy", "scipy"])
    two = store.key("train", {"b": [1, np.int64(2)], "a": 1}, code=[triple, double], libraries=["scipy", "numpy"])
    assert one == two


def test_key_follows_the_bytes_of_modules_packages_and_folders(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "source" / "keyed_package"
    (package / "part").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('a package is imported only for its submodules')")
    (package / "part" / "deep.py").write_text("x = 1\n")
    (tmp_path / "source" / "keyed_module.py").write_text("raise RuntimeError('modules must not be imported')")
    model = tmp_path / "model.xml"
    model.write_text("<mujoco/>")
    monkeypatch.syspath_prepend(str(tmp_path / "source"))

    def key() -> Key:
        return Store(store.root).key("stage", {}, code=["keyed_package", "keyed_module", model, tmp_path / "source"])

    first = key()
    assert set(first.recipe["code"]) >= {"keyed_module", "keyed_package/part/deep.py", "model.xml"}
    for file in (package / "part" / "deep.py", tmp_path / "source" / "keyed_module.py", model):
        before = key()
        file.write_text(file.read_text() + "\n")
        assert key() != before
    (package / "part" / "__pycache__").mkdir()
    (package / "part" / "__pycache__" / "deep.pyc").write_bytes(b"x")
    (package / "part" / "__pycache__" / "deep.py").write_bytes(b"x")
    before = key()
    (package / "part" / "__pycache__" / "deep.py").unlink()
    assert key() == before


def test_key_follows_library_versions(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    before = store.key("stage", {})
    monkeypatch.setattr(store_module, "_version", lambda name: "999" if name == "mujoco" else "1")
    after = store.key("stage", {})
    assert before != after and after.recipe["libraries"]["mujoco"] == "999"
    assert store.key("stage", {}, libraries=["no-such-distribution"])


@pytest.mark.parametrize("stage", ["", "Train", "a b", "../up", "a-", "-a", "a/b"])
def test_stage_names_are_safe_as_folders(store: Store, stage: str) -> None:
    with pytest.raises(ValueError, match="lower-case"):
        store.key(stage, {})


@pytest.mark.parametrize(
    ("bad", "error", "message"),
    [
        ({"a": [1, {"b": float("nan")}]}, ValueError, r"settings\['a'\]\[1\]\['b'\] is nan"),
        ({"a": object()}, TypeError, r"settings\['a'\] is of type object"),
        ({1: 2}, TypeError, "name 1 of type int"),
        ({"a": {1, 2}}, TypeError, "type set"),
    ],
)
def test_settings_that_json_cannot_hold_are_named(store: Store, bad: object, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        store.key("stage", bad)


def test_missing_code_is_named(store: Store, tmp_path: Path) -> None:
    with pytest.raises(ModuleNotFoundError, match="safeswitch.no_such"):
        store.key("stage", {}, code=["safeswitch.no_such"])
    with pytest.raises(ModuleNotFoundError, match="no_such.module"):
        store.key("stage", {}, code=["no_such.module"])
    with pytest.raises(FileNotFoundError, match="no-such.xml"):
        store.key("stage", {}, code=[tmp_path / "no-such.xml"])


def test_key_reaches_workers_with_its_recipe(store: Store) -> None:
    key = store.key("stage", {"a": 1})
    copy = pickle.loads(pickle.dumps(key))
    assert copy == key and copy.recipe == key.recipe
    fill(store, copy, 1.0)
    assert store.has(key)


# ---- results


def test_a_result_is_there_after_writing_with_a_readable_recipe(store: Store) -> None:
    key = store.key("train", Config(), inputs=["demos-1"], code=[double])
    assert not store.has(key) and store.keys() == []
    assert store.folder(key) == store.root / key
    with store.writing(key) as folder:
        assert folder.is_dir() and not store.has(key)
        save_arrays(folder / "arrays.npz", loss=[1.0, 0.5])
        (folder / "sub").mkdir()
        (folder / "sub" / "note.txt").write_text("kept")
    assert store.has(key) and store.keys() == [key] and not folder.exists()
    np.testing.assert_array_equal(store.arrays(key)["loss"], [1.0, 0.5])
    assert (store.folder(key) / "sub" / "note.txt").read_text() == "kept"
    recipe = store.recipe(key)
    assert recipe["stage"] == "train" and recipe["settings"] == {"width": 256, "dropout": 0.1, "angles": [2]}
    assert recipe["inputs"] == ["demos-1"] and list(recipe["code"]) == [f"{__name__}:double"]
    assert recipe["key"] == key


def test_nothing_is_left_of_a_block_that_fails(store: Store) -> None:
    key = store.key("stage", {})
    for error in (ValueError, KeyboardInterrupt):
        with pytest.raises(error), store.writing(key) as folder:
            save_arrays(folder / "arrays.npz", a=1)
            raise error
        assert not store.has(key) and not folder.exists()
    fill(store, key, 3.0)
    assert store.arrays(key)["value"] == 3.0


def test_writing_needs_the_recipe(store: Store) -> None:
    with pytest.raises(TypeError, match="needs the Key"), store.writing("stage-123"):
        pass


def test_missing_results_say_where_they_were_sought(store: Store) -> None:
    for read in (store.arrays, store.recipe):
        with pytest.raises(FileNotFoundError, match="stage-123.*run its stage"):
            read("stage-123")


def test_two_writers_of_one_key_leave_one_whole_result(store: Store) -> None:
    key, both = store.key("stage", {}), threading.Barrier(2)

    def write(value: float) -> None:
        with store.writing(key) as folder:
            save_arrays(folder / "arrays.npz", value=np.full(1000, value), twin=np.full(1000, value))
            both.wait(timeout=10)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(write, [1.0, 2.0]))
    arrays = store.arrays(key)
    np.testing.assert_array_equal(arrays["value"], arrays["twin"])
    assert list((store.root / ".writing").iterdir()) == []


def test_an_incomplete_folder_in_the_way_is_replaced(store: Store) -> None:
    key = store.key("stage", {})
    (store.root / key).mkdir(parents=True)
    (store.root / key / "half.bin").write_bytes(b"x")
    assert not store.has(key)
    fill(store, key, 1.0)
    assert store.has(key) and not (store.root / key / "half.bin").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_kill_in_the_middle_leaves_no_result_and_no_litter(store: Store) -> None:
    script = textwrap.dedent(
        """
        import sys, time
        from safeswitch.store import Store, save_arrays
        store = Store(sys.argv[1])
        with store.writing(store.key("stage", {"a": 1})) as folder:
            save_arrays(folder / "arrays.npz", a=1)
            print("half", flush=True)
            time.sleep(60)
        """
    )
    with subprocess.Popen([sys.executable, "-c", script, str(store.root)], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None and child.stdout.readline() == "half\n"
        unfinished = store.root / ".writing"
        key = store.key("stage", {"a": 1})
        fill(store, store.key("other", {}), 1.0)  # sweeps, but the child is alive
        assert len(list(unfinished.iterdir())) == 1
        os.kill(child.pid, signal.SIGKILL)
        child.wait(timeout=10)
    assert not store.has(key) and len(list(unfinished.iterdir())) == 1
    fill(store, key, 2.0)
    assert store.arrays(key)["value"] == 2.0 and list(unfinished.iterdir()) == []


def test_unfinished_folders_of_other_hosts_are_kept_a_week(store: Store) -> None:
    fresh, stale = store.root / ".writing" / "elsewhere~1~aa", store.root / ".writing" / "elsewhere~2~bb"
    for folder in (fresh, stale):
        folder.mkdir(parents=True)
    os.utime(stale, (0, 0))
    fill(store, store.key("stage", {}), 1.0)
    assert fresh.exists() and not stale.exists()


def test_prune_keeps_what_it_is_told_to(store: Store) -> None:
    keys = [store.key("stage", {"seed": seed}) for seed in range(4)]
    for key in keys:
        fill(store, key, 1.0)
    before = store.size()
    freed = store.prune(keep={keys[1], "never-made"})
    assert store.keys() == [keys[1]] and freed > 0 and store.size() == before - freed
    assert Store(store.root / "nowhere").size() == 0 and Store(store.root / "nowhere").prune(()) == 0


def test_default_root(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SAFESWITCH_STORE", str(tmp_path / "mine"))
    assert default_root() == Store().root == tmp_path / "mine"
    monkeypatch.delenv("SAFESWITCH_STORE")
    checkout = Path(__file__).resolve().parents[1]
    assert default_root() in (checkout / ".safeswitch" / "store", Path.home() / ".cache" / "safeswitch" / "store")


# ---- files


def test_arrays_have_the_same_bytes_every_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arrays = {"signal:total-mean3": np.arange(6.0).reshape(2, 3), "start|cem@total|mu": np.float32(1), "path": [True]}
    for name in ("one.npz", "two.npz"):
        save_arrays(tmp_path / name, **arrays)
        monkeypatch.setattr("time.time", lambda: 2e9)
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()
    loaded = load_arrays(tmp_path / "one.npz")
    assert list(loaded) == list(arrays) and loaded["start|cem@total|mu"].dtype == np.float32
    save_arrays_compressed(tmp_path / "small.npz", zeros=np.zeros(10_000))
    assert (tmp_path / "small.npz").stat().st_size < 2000
    np.testing.assert_array_equal(load_arrays(tmp_path / "small.npz")["zeros"], np.zeros(10_000))


def test_no_pickle_goes_in_or_comes_out(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="[Oo]bject"):
        save_arrays(tmp_path / "bad.npz", a=np.array([object()]))
    assert list(tmp_path.iterdir()) == []
    np.savez(tmp_path / "foreign.npz", a=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="allow_pickle"):
        load_arrays(tmp_path / "foreign.npz")


def test_frames_come_back_as_they_were(tmp_path: Path) -> None:
    frame = pd.DataFrame(
        {
            "method": ["cem@total", "größer", ""],
            "success": [True, False, True],
            "seed": np.array([1, 2, 2**60]),
            "t_first": [1.0, np.nan, np.inf],
        },
        index=[5, 6, 7],
    )
    save_frame(tmp_path / "frame.npz", frame)
    pd.testing.assert_frame_equal(load_frame(tmp_path / "frame.npz"), frame.reset_index(drop=True))
    with pytest.raises(TypeError, match="column 'method'.*None"):
        save_frame(tmp_path / "frame.npz", pd.DataFrame({"method": ["a", None]}, dtype=object))


def test_a_writer_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "table.csv"
    atomic_write_text(path, "µ,σ\r\n1,2\n")
    assert path.read_bytes() == "µ,σ\r\n1,2\n".encode()
    with pytest.raises(UnicodeEncodeError):
        atomic_write_text(path, "\ud800")
    with pytest.raises(ValueError):
        save_arrays(path, a=np.array([object()]))
    assert path.read_bytes() == "µ,σ\r\n1,2\n".encode() and [each.name for each in path.parent.iterdir()] == [path.name]


def test_files_get_ordinary_permissions(tmp_path: Path, store: Store) -> None:
    (tmp_path / "plain").write_text("")
    atomic_write_text(tmp_path / "atomic", "")
    assert (tmp_path / "atomic").stat().st_mode == (tmp_path / "plain").stat().st_mode
    fill(store, store.key("stage", {}), 1.0)
    (tmp_path / "folder").mkdir()
    assert store.folder(store.keys()[0]).stat().st_mode == (tmp_path / "folder").stat().st_mode


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda each: st.lists(each, max_size=3) | st.dictionaries(st.text(), each, max_size=3),
    max_leaves=10,
)


@settings(max_examples=50, deadline=None)
@given(JSON)
def test_json_round_trip(value: object) -> None:
    assert jsonable(value) == value
    assert json.loads(json.dumps(jsonable(value))) == value


def test_json_files_take_nan_as_null(tmp_path: Path) -> None:
    save_json(
        tmp_path / "a.json", {"threshold": float("nan"), "mu": np.float64(0.1), "shape": (2, 3), "at": Path("a/b")}
    )
    assert load_json(tmp_path / "a.json") == {"threshold": None, "mu": 0.1, "shape": [2, 3], "at": "a/b"}
    with pytest.raises(ValueError, match=r"a.json\['x'\] is inf"):
        save_json(tmp_path / "a.json", {"x": float("inf")})
