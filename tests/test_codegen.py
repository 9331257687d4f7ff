"""Code generation: compiled equals interpreted, the cache is used, and a missing compiler costs speed only."""

from __future__ import annotations

import warnings
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from safeswitch.expert import codegen

needs_compiler = pytest.mark.skipif(codegen.find_compiler() is None, reason="no C compiler")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SAFESWITCH_CACHE", str(tmp_path / "cache"))
    codegen._warn_once.cache_clear()
    return tmp_path / "cache"


def example(factor: float = 2.0) -> ca.Function:
    A, v = ca.MX.sym("A", 2, 3), ca.MX.sym("v", 3)
    return ca.Function("example", [A, v], [factor * ca.sin(A) @ v, ca.densify(ca.diag(v))], ["A", "v"], ["w", "D"])


@needs_compiler
def test_compiled_function_equals_the_expression(cache: Path) -> None:
    function = example()
    built = codegen.build(function)
    assert codegen.is_compiled(built) and not codegen.is_compiled(function)
    A, v = np.arange(6.0).reshape(2, 3), np.array([1.0, -2.0, 0.5])
    for got, want in zip(built(A, v), function(A, v), strict=True):
        np.testing.assert_allclose(np.array(got), np.array(want), rtol=1e-15, atol=1e-15)


@needs_compiler
def test_kernel_arrays_are_transposed_matrices(cache: Path) -> None:
    for function in (example(), codegen.build(example())):
        kernel = codegen.Kernel(function)
        A, v = np.arange(6.0).reshape(2, 3), np.array([1.0, -2.0, 0.5])
        kernel.inputs["A"][:], kernel.inputs["v"][:] = A.T, v
        for _ in range(2):  # the buffers stay bound
            kernel()
            np.testing.assert_allclose(kernel.outputs["w"], 2.0 * np.sin(A) @ v, rtol=1e-15)
            v *= 2.0
            kernel.inputs["v"][:] = v
        np.testing.assert_array_equal(kernel.outputs["D"], np.diag(v / 2.0))


@needs_compiler
def test_second_build_comes_from_the_cache(cache: Path) -> None:
    codegen.build(example())
    (library,) = cache.glob("*.so")
    stamp = library.stat().st_mtime_ns
    codegen.build(example())
    assert [path.stat().st_mtime_ns for path in cache.glob("*.so")] == [stamp]
    assert [path.name for path in cache.iterdir()] == [library.name]  # no scratch is left behind


@needs_compiler
def test_same_name_and_other_content_live_side_by_side(cache: Path) -> None:
    one, two = codegen.build(example(1.0)), codegen.build(example(3.0))
    assert len(list(cache.glob("*.so"))) == 2
    A, v = np.ones((2, 3)), np.ones(3)
    np.testing.assert_allclose(3.0 * np.array(one(A, v)[0]), np.array(two(A, v)[0]), rtol=1e-15)


@needs_compiler
def test_flags_are_part_of_the_key(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    codegen.build(example())
    monkeypatch.setattr(codegen, "FLAGS", (*codegen.FLAGS, "-DOTHER"))
    codegen.build(example())
    assert len(list(cache.glob("*.so"))) == 2


def test_flags_keep_the_arithmetic_of_ieee() -> None:
    assert not any("fast-math" in flag for flag in codegen.FLAGS)
    assert "-ffp-contract=off" in codegen.FLAGS


@pytest.mark.parametrize("compiler", ["no-such-compiler", "false"])
def test_without_a_working_compiler_the_virtual_machine_runs_with_one_warning(
    cache: Path, monkeypatch: pytest.MonkeyPatch, compiler: str
) -> None:
    monkeypatch.setenv("SAFESWITCH_COMPILER", compiler)
    with pytest.warns(RuntimeWarning, match="virtual machine"):
        built = codegen.build(example())
    assert not codegen.is_compiled(built)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        codegen.build(example())


def test_an_unwritable_cache_falls_back(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SAFESWITCH_CACHE", str(tmp_path / "file"))
    with pytest.warns(RuntimeWarning, match="virtual machine"):
        assert not codegen.is_compiled(codegen.build(example()))


def test_kernel_refuses_sparse_arguments() -> None:
    v = ca.MX.sym("v", 3)
    with pytest.raises(ValueError, match="dense"):
        codegen.Kernel(ca.Function("sparse", [v], [ca.diag(v)]))


def test_cache_folder_can_be_moved(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SAFESWITCH_CACHE", str(tmp_path))
    assert codegen.cache_dir() == tmp_path
    monkeypatch.delenv("SAFESWITCH_CACHE")
    assert codegen.cache_dir() == Path.home() / ".cache" / "safeswitch"
