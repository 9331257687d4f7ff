"""The backend and the device: what is there is used, and what is missing is named with its remedy."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from safeswitch.tasks import opengl

LINUX = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="EGL and OSMesa exist on Linux only")


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `code` in a fresh interpreter with MUJOCO_GL and the like set anew."""
    fresh = ("MUJOCO_GL", "PYOPENGL_PLATFORM", opengl.DEVICE)
    clean = {key: value for key, value in os.environ.items() if key not in fresh}
    command = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(command, env={**clean, **environment}, capture_output=True, text=True, timeout=120)


def without(*names: str) -> str:
    """Code after which the libraries whose names contain one of `names` cannot be loaded."""
    return f"""
import ctypes
load = ctypes.CDLL.__init__
def refuse(self, name, *args, **kwargs):
    if name and any(each in str(name) for each in {names!r}):
        raise OSError(f"{{name}}: cannot open shared object file")
    load(self, name, *args, **kwargs)
ctypes.CDLL.__init__ = refuse
"""


STEP_AND_RENDER = """
import os
import gymnasium as gym, safeswitch
env = gym.make("SafeSwitch/CartPole-v0", render_mode="rgb_array", width=96, height=64)
env.reset(seed=0)
env.step(env.action_space.sample() * 0)
from safeswitch.tasks.rendering import describe_renderer, probe
print(os.environ["MUJOCO_GL"], probe())
print(env.render().std() > 15, describe_renderer())
"""


@LINUX
@pytest.mark.parametrize("environment", [{"MUJOCO_GL": "egl"}, {}])
def test_without_any_library_physics_works_and_pictures_say_what_to_install(environment: dict[str, str]) -> None:
    result = run(without("EGL", "OSMesa") + STEP_AND_RENDER, **environment)
    assert result.returncode == 1
    last = result.stderr.splitlines()[-1]
    assert "neither EGL (libEGL.so.1 with libOpenGL.so.0) nor OSMesa" in last
    assert "apt-get install -y libegl1 libgl1-mesa-dri libopengl0" in last
    assert "apt-get install -y libosmesa6" in last
    assert result.stdout.startswith("disabled (False") and opengl.REMEDY in result.stdout


def c_library() -> str:
    """Path of the C library: one that every process can load."""
    loaded = Path("/proc/self/maps").read_text().split()
    return next(each for each in loaded if re.search(r"/libc(\.so|-[0-9])", each))


@LINUX
@pytest.mark.parametrize("missing", ["EGL", "GL"])
@pytest.mark.parametrize("environment", [{"MUJOCO_GL": "egl"}, {}])
def test_osmesa_is_chosen_when_egl_is_missing(tmp_path: Path, missing: str, environment: dict[str, str]) -> None:
    # Some library by the name of OSMesa's: that it can be loaded is what decides.
    (tmp_path / "libOSMesa.so.8").symlink_to(c_library())
    code = "import os, safeswitch.tasks; print(os.environ['MUJOCO_GL'])"
    libraries = ("libEGL",) if missing == "EGL" else ("libGL.", "libOpenGL.")
    result = run(without(*libraries) + code, LD_LIBRARY_PATH=str(tmp_path), **environment)
    assert result.stdout.strip() == "osmesa", result.stderr
    result = run(without(*libraries, "OSMesa") + code, LD_LIBRARY_PATH=str(tmp_path), **environment)
    assert result.stdout.strip() == "disabled", result.stderr


def osmesa_is_here() -> bool:
    """Whether OSMesa can be loaded; asked in another process, since two kinds of Mesa in one may not agree."""
    return "True" in run("from safeswitch.tasks.opengl import has_osmesa; print(has_osmesa())").stdout


@LINUX
@pytest.mark.parametrize("first", ["", "import mujoco\n"])
def test_osmesa_renders_without_egl_and_opengl(first: str) -> None:
    if not osmesa_is_here():
        pytest.skip(f"no OSMesa on this machine: {opengl.ALTERNATIVE}")
    result = run(without("libEGL", "libGL.", "libOpenGL.") + first + STEP_AND_RENDER)
    assert result.stdout.startswith("osmesa (True") and result.stdout.splitlines()[1].startswith("True"), result.stderr
    assert "backend='osmesa'" in result.stdout
    assert not result.stderr


@LINUX
@pytest.mark.parametrize("osmesa", [True, False])
def test_egl_without_drivers_leaves_the_physics_alone(tmp_path: Path, osmesa: bool) -> None:
    drivers = tmp_path / "none.json"  # no driver at all: EGL loads and finds no device
    drivers.write_text("{}")
    (tmp_path / "libOSMesa.so.8").symlink_to(c_library())
    if not opengl.has_egl():
        pytest.skip("no EGL on this machine")
    first = "" if osmesa else without("OSMesa")
    first += "from safeswitch.tasks.opengl import switched_off\nwith switched_off():\n    from dm_control import mjcf\n"
    result = run(
        first + STEP_AND_RENDER, LD_LIBRARY_PATH=str(tmp_path), **{"__EGL_VENDOR_LIBRARY_FILENAMES": str(drivers)}
    )
    last = result.stderr.splitlines()[-1]
    assert result.returncode == 1 and "MUJOCO_GL=egl) fails" in last
    assert result.stdout.startswith("egl (False"), "reset and step worked"
    assert ("Set MUJOCO_GL=osmesa" in last) == osmesa and (opengl.ALTERNATIVE in last) == (not osmesa)
    assert opengl.REMEDY in last


@pytest.mark.rendering
def test_backend_is_chosen_without_any_variable_and_after_mujoco() -> None:
    for first in ("", "import mujoco\n"):
        result = run(first + STEP_AND_RENDER)
        assert result.stdout.splitlines()[1].startswith("True"), result.stderr
        assert not result.stderr, result.stderr


def test_switched_off_keeps_dm_control_from_starting_opengl() -> None:
    code = (
        "import os, sys\nfrom safeswitch.tasks.opengl import switched_off\nbefore = os.environ.get('MUJOCO_GL')\n"
        "with switched_off():\n    from dm_control import mjcf\n"
        "from dm_control import _render\n"
        "print(_render.BACKEND, os.environ.get('MUJOCO_GL') == before, 'mujoco' in sys.modules)\n"
    )
    result = run(code)
    assert result.stdout.split()[-2:] == ["True", "True"] and result.stdout.startswith("off"), result.stderr


@LINUX
@pytest.mark.rendering
def test_egl_is_the_default() -> None:
    if not opengl.has_egl():
        pytest.skip("no EGL on this machine")
    assert run(STEP_AND_RENDER).stdout.startswith("egl (True")


def test_importing_loads_neither_mujoco_nor_an_opengl_binding() -> None:
    code = "import sys, safeswitch.tasks.rendering; print({'mujoco', 'dm_control', 'OpenGL'} & set(sys.modules))"
    assert run(code).stdout.strip() == "set()"


def test_other_backends_are_the_users_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    for value in ("osmesa", "glfw", "disabled"):
        monkeypatch.setenv("MUJOCO_GL", value)
        assert opengl.choose_backend() == value == os.environ["MUJOCO_GL"]


def test_nothing_is_set_on_other_systems(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    assert opengl.choose_backend() == "" and "MUJOCO_GL" not in os.environ
    assert not opengl.has_egl() and not opengl.has_osmesa()


def test_rendering_that_is_switched_off_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opengl, "has_egl", lambda: True)
    for value in opengl.OFF:
        monkeypatch.setenv("MUJOCO_GL", value)
        with pytest.raises(RuntimeError, match=f"MUJOCO_GL={value} switches rendering off. Unset it"):
            opengl.make_context(8, 8)


GPU, SOFTWARE = "EGL_EXT_device_drm", "EGL_MESA_device_software EGL_EXT_device_drm_render_node"


@pytest.mark.parametrize(
    ("extensions", "broken", "chosen"),
    [
        ([], [], None),
        ([SOFTWARE], [], None),
        ([GPU], [], None),
        ([GPU, SOFTWARE], [], None),  # mujoco's own order is right: the first that starts
        ([GPU, GPU, SOFTWARE], [0], None),
        ([SOFTWARE, GPU], [], 1),
        ([SOFTWARE, GPU, GPU], [1], 2),
        ([SOFTWARE, GPU], [1], None),
        ([GPU, SOFTWARE, GPU], [0], 2),
        ([GPU, SOFTWARE, GPU], [], 0),
    ],
)
def test_a_gpu_that_starts_goes_before_software(extensions: list[str], broken: list[int], chosen: int | None) -> None:
    assert opengl.hidden_gpu(extensions, lambda index: index not in broken) == chosen


DEVICES = """
import os
from mujoco.egl import egl_ext
from safeswitch.tasks import opengl
devices = egl_ext.eglQueryDevicesEXT()
{lie}
found = opengl.describe_renderer()
opengl.make_context(8, 8).free()
print(len(devices), os.environ.get("MUJOCO_EGL_DEVICE_ID"), bool(found.renderer))
"""

# The devices of this machine a second time, called GPUs; the rest of the way is real.
TWICE = """
egl_ext.eglQueryDevicesEXT = lambda: devices + devices
opengl._device_extensions = lambda: ["EGL_MESA_device_software"] * len(devices) + [""] * len(devices)
"""
# ... and they do not start.
DEAD = """
egl_ext.eglQueryDevicesEXT = lambda: devices + [None]
opengl._device_extensions = lambda: ["EGL_MESA_device_software"] * len(devices) + [""]
"""


@LINUX
@pytest.mark.rendering
def test_device_in_the_variable_mujoco_reads() -> None:
    if os.environ.get("MUJOCO_GL", "egl") != "egl" or not opengl.has_egl():
        pytest.skip("about EGL")
    count = int(run(DEVICES.format(lie="")).stdout.split()[0])
    assert run(DEVICES.format(lie=TWICE)).stdout.split() == [str(count), str(count), "True"]
    dead = run(DEVICES.format(lie=DEAD))
    assert dead.stdout.split() == [str(count), "None", "True"], dead.stderr
    # The user's choice stands.
    assert run(DEVICES.format(lie=TWICE), MUJOCO_EGL_DEVICE_ID="0").stdout.split() == [str(count), "0", "True"]
    wrong = run(DEVICES.format(lie=""), MUJOCO_EGL_DEVICE_ID="99")
    assert "MUJOCO_EGL_DEVICE_ID" in wrong.stderr and "got 99" in wrong.stderr
