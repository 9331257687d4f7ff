"""Pictures of a task: one off-screen renderer per environment, on `mujoco`'s own OpenGL functions.

What was measured on Mesa's software rasteriser at 64 x 64: default settings about 100 frames/s; without shadow,
reflection and skybox 1,270; without multisampling too 4,250; with coarse shapes too 7,850. `fast=True` sets all of
these. Cost follows the size of the off-screen buffer, so that it is always the size of the picture.

Importing this module imports neither `mujoco` nor an OpenGL library: `choose_backend` has to run before they do.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import sys
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import mujoco

Image = NDArray[np.uint8]

REMEDY = "apt-get install -y libegl1 libgl1-mesa-dri libopengl0"
"""The Debian command that installs what off-screen rendering needs."""

MAX_GEOMS = 1000

_gl_process: int | None = None
"""Process that has used OpenGL first, here or in a parent."""

_abandoned: list[Any] = []
"""OpenGL objects that this process or thread cannot free; kept, because their destructors would try to."""


def has_egl() -> bool:
    """Whether EGL can be loaded, and OpenGL beside it as PyOpenGL looks for it (Linux only)."""
    if not sys.platform.startswith("linux"):
        return False
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    return any(ctypes.util.find_library(name) for name in ("OpenGL", "GL"))


def choose_backend() -> str:
    """Settle `MUJOCO_GL` before `mujoco` or `dm_control` reads it, and return it.

    On Linux an unset variable becomes `egl`, which needs no display. Where it says `egl` (or nothing) and there is no
    EGL library, importing mujoco or dm_control would fail: it becomes `disabled`, physics works, and the first picture
    raises an error that says what to install. Other values are the user's choice; on other systems nothing is touched.
    """
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    if sys.platform.startswith("linux") and chosen in ("", "egl"):
        chosen = "egl" if has_egl() else "disabled"
        os.environ["MUJOCO_GL"] = chosen
    return chosen


def probe(width: int = 32, height: int = 32) -> tuple[bool, str]:
    """Render one small frame for real: (True, the backend) or (False, what is wrong and what to do)."""
    import mujoco

    xml = (
        "<mujoco><visual><rgba haze='1 1 1 1'/></visual><worldbody>"
        "<light pos='0 0 3'/><camera name='c' pos='0 0 2'/><geom type='sphere' size='.3' rgba='1 0 0 1'/>"
        "</worldbody></mujoco>"
    )
    try:
        model = mujoco.MjModel.from_xml_string(xml)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        renderer = Renderer(model, width, height, "c", fast=True)
        picture = renderer.render(model, data)
        renderer.close()
    except Exception as error:  # whatever the driver throws, the answer is a message
        return False, str(error)
    backend = os.environ.get("MUJOCO_GL") or "default"
    red, green, blue = (int(value) for value in picture[height // 2, width // 2])
    if red <= blue + 20:
        return False, f"OpenGL ({backend}) renders wrong pixels: a red ball came out as RGB {red}, {green}, {blue}"
    return True, f"OpenGL ({backend}) renders {width} x {height} frames"


class Renderer:
    """Renders one model, nominal or disturbed, through one camera into RGB pictures.

    Args:
        model: decides textures, meshes and the number of geoms; a disturbed copy may be passed to `render`.
        width: of the picture [pixel].
        height: of the picture [pixel].
        camera: name of a camera of the model.
        fast: no shadows, reflections, skybox or multisampling, and coarse shapes: for observations, not for the eye.

    Raises:
        RuntimeError: there is no OpenGL to render with; the message says what to install.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int, camera: str, *, fast: bool = False) -> None:
        import mujoco

        if width < 1 or height < 1:
            raise ValueError(f"a picture has at least 1 x 1 pixels, got width {width} and height {height}")
        self.width, self.height, self.fast = int(width), int(height), fast
        self._mujoco = mujoco
        self._scene = mujoco.MjvScene(model, maxgeom=MAX_GEOMS)
        self._option = mujoco.MjvOption()
        self._camera = _camera(model, camera)
        self._rect = mujoco.MjrRect(0, 0, self.width, self.height)
        self._gl = _gl_context(self.width, self.height)
        self._gl.make_current()
        with _quality(model, self.width, self.height, fast):
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        if fast:
            for flag in ("mjRND_SHADOW", "mjRND_REFLECTION", "mjRND_SKYBOX", "mjRND_HAZE"):
                self._scene.flags[getattr(mujoco.mjtRndFlag, flag)] = 0
        self._close = weakref.finalize(self, _free, self._gl, self._context, threading.get_ident(), os.getpid())

    def render(self, model: mujoco.MjModel, data: mujoco.MjData) -> Image:
        """Picture (height, width, 3) of `data`, whose kinematics must be up to date, in the looks of `model`."""
        if not self._close.alive:
            raise RuntimeError("this renderer is closed")
        _refuse_after_fork()
        mj = self._mujoco
        self._gl.make_current()
        everything = mj.mjtCatBit.mjCAT_ALL.value
        mj.mjv_updateScene(model, data, self._option, None, self._camera, everything, self._scene)
        mj.mjr_render(self._rect, self._scene, self._context)
        picture = np.empty((self.height, self.width, 3), np.uint8)
        mj.mjr_readPixels(picture, None, self._rect, self._context)
        return np.ascontiguousarray(picture[::-1])  # OpenGL's first row is the lowest one

    def close(self) -> None:
        """Free the OpenGL objects; harmless when called again."""
        self._close()


def _free(gl: Any, context: Any, thread: int, process: int) -> None:
    """Free the objects of one renderer in its own context: in another one they would be somebody else's."""
    # A context belongs to its thread, and after a fork to the parent: there, leaking is the only safe choice.
    if thread != threading.get_ident() or process != os.getpid():
        _abandoned.append((gl, context))
        return
    gl.make_current()
    context.free()
    gl.free()


def _camera(model: mujoco.MjModel, name: str) -> mujoco.MjvCamera:
    """The fixed camera `name` of the model."""
    import mujoco

    from safeswitch.names import unknown

    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, name)
    if index < 0:
        raise unknown("camera", name, [model.camera(i).name for i in range(model.ncam)])
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
    camera.fixedcamid = index
    return camera


def _gl_context(width: int, height: int) -> Any:
    """An off-screen OpenGL context of the chosen backend."""
    _refuse_after_fork()
    backend = os.environ.get("MUJOCO_GL", "").strip().lower()
    on_linux = sys.platform.startswith("linux")
    if on_linux and backend in ("", "egl", "disabled") and not has_egl():
        raise RuntimeError(
            f"cannot render: EGL (libEGL.so.1) or OpenGL (libOpenGL.so.0) is missing. On Debian or Ubuntu run: {REMEDY}"
        )
    try:
        if on_linux and backend in ("", "egl"):
            # Explicitly, because mujoco may have been imported before the backend was chosen.
            from mujoco.egl import GLContext
        else:
            from mujoco.gl_context import GLContext
        return GLContext(width, height)
    except Exception as error:
        advice = f" On Debian or Ubuntu run: {REMEDY}" if on_linux else ""
        raise RuntimeError(f"cannot render: OpenGL (MUJOCO_GL={backend or 'unset'}) fails: {error}.{advice}") from error


def _refuse_after_fork() -> None:
    """Refuse OpenGL in a forked child of a process that has used it: without the driver's threads it would hang."""
    global _gl_process
    if _gl_process is None:
        _gl_process = os.getpid()
    if _gl_process != os.getpid():
        raise RuntimeError(
            "cannot render: this process was forked from one that had rendered already, in which OpenGL would hang. "
            "Start workers with the method 'spawn', for example gym.make_vec(..., vector_kwargs={'context': 'spawn'})"
        )


@contextmanager
def _quality(model: mujoco.MjModel, width: int, height: int, fast: bool) -> Iterator[None]:
    """Set the picture quality that a rendering context reads from the model while it is made, and nowhere else."""
    wanted: list[tuple[Any, str, int]] = [
        (model.vis.global_, "offwidth", width),
        (model.vis.global_, "offheight", height),
    ]
    if fast:
        quality = model.vis.quality
        wanted += [(quality, "offsamples", 0), (quality, "numslices", 8), (quality, "numstacks", 4)]
        wanted += [(quality, "numquads", 1), (quality, "shadowsize", 0)]
    before = [getattr(part, name) for part, name, _ in wanted]
    for part, name, value in wanted:
        setattr(part, name, value)
    try:
        yield
    finally:
        for (part, name, _), value in zip(wanted, before, strict=True):
            setattr(part, name, value)
