"""Pictures of a task: one off-screen renderer per environment, on `mujoco`'s own OpenGL functions.

What was measured on Mesa's software rasteriser at 64 x 64: default settings about 100 frames/s; without shadow,
reflection and skybox 1,270; without multisampling too 4,250; with coarse shapes too 7,850. `fast=True` sets all of
these. Cost follows the size of the off-screen buffer, so that it is always the size of the picture.

OpenGL objects are freed in the context that they belong to (elsewhere they would be somebody else's), by the thread
that made them, and never by the garbage collector, which may run in the middle of another renderer's frame.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from safeswitch.tasks.opengl import REMEDY, choose_backend, describe_renderer, make_context, refuse_after_fork

if TYPE_CHECKING:
    import mujoco

__all__ = ["REMEDY", "Image", "Renderer", "choose_backend", "describe_renderer", "probe", "quality", "simplify"]

Image = NDArray[np.uint8]

MAX_GEOMS = 1000

COSTLY = ("mjRND_SHADOW", "mjRND_REFLECTION", "mjRND_SKYBOX", "mjRND_HAZE")
"""What a fast picture does without."""


@dataclass(eq=False)
class _Objects:
    """OpenGL objects of one renderer.

    A context belongs to its thread, and after a fork to the parent: elsewhere, keeping it is the only safe choice.
    """

    gl: Any
    context: Any
    thread: int
    process: int
    left: bool = False

    def leave(self) -> None:
        """Say that the renderer is gone; harmless at any moment."""
        self.left = True

    @property
    def mine(self) -> bool:
        """Whether this thread may touch them."""
        return self.thread == threading.get_ident() and self.process == os.getpid()


_objects: list[_Objects] = []
"""Of every renderer that has not been freed."""

_busy = threading.local()
"""`_busy.now` while a context of this thread is in use."""


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
        if fast:
            simplify(self._scene)
        _sweep()
        with _in_use():
            self._gl = make_context(self.width, self.height)
            self._gl.make_current()
            with quality(model, self.width, self.height, fast):
                self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._close = weakref.finalize(self, _remember(self._gl, self._context).leave)
        self._close.atexit = False  # `_at_exit` does it, before mujoco ends EGL

    def render(self, model: mujoco.MjModel, data: mujoco.MjData) -> Image:
        """Picture (height, width, 3) of `data`, whose kinematics must be up to date, in the looks of `model`."""
        if not self._close.alive:
            raise RuntimeError("this renderer is closed")
        refuse_after_fork()
        mj = self._mujoco
        picture = np.empty((self.height, self.width, 3), np.uint8)
        with _in_use():
            self._gl.make_current()
            everything = mj.mjtCatBit.mjCAT_ALL.value
            mj.mjv_updateScene(model, data, self._option, None, self._camera, everything, self._scene)
            mj.mjr_render(self._rect, self._scene, self._context)
            mj.mjr_readPixels(picture, None, self._rect, self._context)
        return np.ascontiguousarray(picture[::-1])  # OpenGL's first row is the lowest one

    def close(self) -> None:
        """Free the OpenGL objects; harmless when called again."""
        self._close()
        _sweep()


def _remember(gl: Any, context: Any) -> _Objects:
    """Keep the objects of a new renderer until they are freed, at the latest when Python ends."""
    # Again and again: what is registered last runs first, and mujoco and dm_control register EGL's end in between.
    atexit.unregister(_at_exit)
    atexit.register(_at_exit)
    objects = _Objects(gl, context, threading.get_ident(), os.getpid())
    _objects.append(objects)
    return objects


@contextmanager
def _in_use() -> Iterator[None]:
    """Nothing is freed meanwhile: that would leave the thread without a current context."""
    _busy.now = True
    try:
        yield
    finally:
        _busy.now = False


def _sweep(everything: bool = False) -> None:
    """Free the objects of this thread whose renderers are gone, or of all its renderers; not within a frame."""
    if getattr(_busy, "now", False):
        return
    with _in_use():
        for each in [each for each in _objects if each.mine and (each.left or everything)]:
            each.gl.make_current()
            each.context.free()
            each.gl.free()
            _objects.remove(each)


def _at_exit() -> None:
    """Free what this thread can, and keep the destructors of the rest from trying."""
    with suppress(Exception):  # EGL may have ended already
        _sweep(everything=True)
    for each in _objects:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(each.gl))
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(each.context))


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


def simplify(scene: mujoco.MjvScene) -> None:
    """Switch off in a scene what a fast picture does without."""
    import mujoco

    for flag in COSTLY:
        scene.flags[getattr(mujoco.mjtRndFlag, flag)] = 0


@contextmanager
def quality(model: mujoco.MjModel, width: int, height: int, fast: bool) -> Iterator[None]:
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
