"""What is shipped: metadata that agrees with itself, and distributions that work away from the checkout."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import textwrap
import tomllib
import venv
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {"safeswitch": ROOT / "benchmark", "safeswitch_baselines": ROOT / "baselines"}

pytestmark = pytest.mark.skipif(not (ROOT / "pyproject.toml").is_file(), reason="needs the checkout")


@pytest.fixture(scope="module")
def project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def run(command: list[str], cwd: Path, **environment: str) -> str:
    """Standard output of a command that must succeed, away from this process's search path."""
    inherited = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}
    done = subprocess.run(
        command, cwd=cwd, env={**inherited, **environment}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{command} failed:\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    return done.stdout


# ---- metadata


def pins() -> dict[str, Version]:
    lines = (line.partition("#")[0].strip() for line in (ROOT / "constraints.txt").read_text().splitlines())
    pairs = (line.split("==") for line in lines if line)
    return {canonicalize_name(name): Version(version) for name, version in pairs}


def test_constraints_pin_every_requirement_within_its_range(project: dict[str, Any]) -> None:
    extras = project["optional-dependencies"]
    listed = [*project["dependencies"], *(each for name, extra in extras.items() if name != "hooks" for each in extra)]
    for requirement in map(Requirement, listed):
        pinned = pins().get(canonicalize_name(requirement.name))
        assert pinned is not None, f"constraints.txt does not pin {requirement.name}"
        assert requirement.specifier.contains(pinned), f"{requirement} does not admit the pinned {pinned}"


def test_mujoco_stays_below_4(project: dict[str, Any]) -> None:
    (mujoco,) = (r for r in map(Requirement, project["dependencies"]) if r.name == "mujoco")
    assert not mujoco.specifier.contains("4.0.0") and mujoco.specifier.contains("3.17.0")
    assert SpecifierSet(project["requires-python"]) == SpecifierSet(">=3.11,<3.13")


def test_entry_points_load(project: dict[str, Any]) -> None:
    groups = {"scripts": project["scripts"], **project["entry-points"]}
    assert {"safeswitch.learners", "safeswitch.signals"} <= set(groups)
    for group, entries in groups.items():
        for name, target in entries.items():
            module, _, attribute = target.partition(":")
            found: Any = __import__(module, fromlist=["_"])
            assert hasattr(found, attribute), f"entry point {name!r} of {group} names {target}, which does not exist"


def test_packages_are_typed_and_versions_agree() -> None:
    for name, root in PACKAGES.items():
        assert (root / name / "py.typed").is_file()
    version = re.search(r'^__version__ = "(.+)"', (ROOT / "benchmark/safeswitch/__init__.py").read_text(), re.MULTILINE)
    assert version is not None
    assert re.search(rf"^version: {re.escape(version[1])}$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)


def test_the_benchmark_imports_neither_torch_nor_baselines() -> None:
    script = """
        import pkgutil, sys
        import safeswitch
        assert not {"torch", "mujoco", "safeswitch_baselines"} & set(sys.modules), "import safeswitch"
        for module in pkgutil.walk_packages(safeswitch.__path__, "safeswitch."):
            if module.name != "safeswitch.__main__":
                __import__(module.name)
                loaded = {"torch", "safeswitch_baselines"} & set(sys.modules)
                assert not loaded, f"{module.name} imports {loaded}"
    """
    roots = os.pathsep.join(str(root) for root in PACKAGES.values())
    run([sys.executable, "-c", textwrap.dedent(script)], ROOT, PYTHONPATH=roots)


def test_make_help_lists_every_target() -> None:
    makefile = (ROOT / "Makefile").read_text()
    targets = set(re.search(r"^\.PHONY: (.+)$", makefile, re.MULTILINE)[1].split())  # type: ignore[index]
    assert targets >= {"bench", "test", "test-slow", "demos", "perf", "lint", "help", "clean"}
    shown = run(["make", "help"], ROOT)
    assert {target for target in targets if f"make {target}" not in shown} == set()


# ---- distributions


@pytest.fixture(scope="module")
def distributions(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """The sdist, the wheel built from the checkout, and the wheel built from the unpacked sdist."""
    folder = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "build", "--outdir"]
    run([*build, str(folder / "direct"), "--wheel", str(ROOT)], folder)
    run([*build, str(folder / "both"), str(ROOT)], folder)  # an sdist, and a wheel from it
    (sdist,) = (folder / "both").glob("*.tar.gz")
    (direct,) = (folder / "direct").glob("*.whl")
    (indirect,) = (folder / "both").glob("*.whl")
    return sdist, direct, indirect


def sources() -> set[str]:
    """Names in a wheel of every file of the packages and of the assets."""
    trees = [(root, root / name, "") for name, root in PACKAGES.items()]
    trees.append((ROOT / "assets", ROOT / "assets", "safeswitch/assets/"))
    return {
        prefix + file.relative_to(base).as_posix()
        for base, tree, prefix in trees
        for file in tree.rglob("*")
        if file.is_file() and "__pycache__" not in file.parts
    }


@pytest.mark.slow
def test_wheels_hold_the_packages_and_the_assets_and_nothing_else(distributions: tuple[Path, Path, Path]) -> None:
    _, direct, indirect = distributions
    for wheel in (direct, indirect):
        with zipfile.ZipFile(wheel) as archive:
            names = {name for name in archive.namelist() if ".dist-info/" not in name}
            about = [name for name in archive.namelist() if ".dist-info/" in name]
        assert names == sources()
        assert any(name.endswith("licenses/LICENSE") for name in about)
        assert any(name.endswith("entry_points.txt") for name in about)


@pytest.mark.slow
def test_sdist_has_what_a_build_and_the_tests_need_but_no_results(distributions: tuple[Path, Path, Path]) -> None:
    with tarfile.open(distributions[0]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "README.md", "LICENSE", "constraints.txt", "Makefile", "scripts/setup.sh"} <= names
    assert {f"tests/{Path(__file__).name}", "benchmark/safeswitch/py.typed"} <= names
    tops = {name.partition("/")[0] for name in names}
    assert not tops & {"results", ".git", ".venv", ".safeswitch", ".ci", "dist", "build"}
    assert distributions[0].stat().st_size < 8e6


@pytest.fixture(scope="module")
def empty_python(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Interpreter of a new virtual environment, outside the checkout."""
    folder = tmp_path_factory.mktemp("empty")
    venv.create(folder / "venv", with_pip=True)
    yield folder / "venv" / "bin" / "python"
    shutil.rmtree(folder)  # gigabytes, which pytest would keep


USE = """
import sys
from pathlib import Path
import gymnasium as gym
import safeswitch, safeswitch_baselines
from importlib.metadata import entry_points, version
from safeswitch.tasks.models import assets_folder

checkout = Path(sys.argv[1])
for path in (Path(safeswitch.__file__), Path(safeswitch_baselines.__file__), assets_folder()):
    assert "site-packages" in path.parts and checkout not in path.parents, path
assert version("safeswitch") == safeswitch.__version__
for env_id in safeswitch.ENTRY_POINTS:
    for name in (env_id, f"safeswitch:{env_id}"):
        env = gym.make(name)
        observation, info = env.reset(seed=1)
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation) and info["step"] == 1
        env.close()
for env_id in safeswitch.HANDOVER_TASKS:
    env = gym.make(env_id)
    observation, info = env.reset(seed=1)
    assert env.observation_space.contains(observation) and not env.step(1)[3]
assert {"bayesian-mlp"} <= {entry.name for entry in entry_points(group="safeswitch.learners")}
for group in ("learners", "signals", "methods"):
    for entry in entry_points(group=f"safeswitch.{group}"):
        entry.load()
print("works", len(safeswitch.ENTRY_POINTS))
"""


@pytest.mark.slow
def test_wheel_and_sdist_work_in_an_empty_environment(
    distributions: tuple[Path, Path, Path], empty_python: Path, tmp_path: Path
) -> None:
    sdist, wheel, _ = distributions
    pip = [str(empty_python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    run([*pip, "-c", str(ROOT / "constraints.txt"), str(wheel)], tmp_path)  # with all that its metadata asks for
    command = empty_python.with_name("safeswitch")
    for _ in ("wheel", "sdist"):
        assert run([str(empty_python), "-c", USE, str(ROOT)], tmp_path).startswith("works")
        assert "bench" in run([str(command), "--help"], tmp_path)
        run([*pip, "--no-deps", "--force-reinstall", str(sdist)], tmp_path)
