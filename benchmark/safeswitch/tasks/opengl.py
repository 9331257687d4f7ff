"""Which OpenGL draws: the backend, the device, and what it calls itself.

The backend has to be settled before `mujoco` or `dm_control` is imported, because they read `MUJOCO_GL` then; therefore
importing this module imports neither of them, and no OpenGL library.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

REMEDY = "apt-get install -y libegl1 libgl1-mesa-dri libopengl0"
"""The Debian command that installs what off-screen rendering needs."""

ALTERNATIVE = "apt-get install -y libosmesa6"
"""The Debian command for rendering without EGL."""

OFF = ("disable", "disabled", "off", "false", "0")
"""Values of `MUJOCO_GL` with which mujoco does not render."""

DEVICE = "MUJOCO_EGL_DEVICE_ID"
"""The variable in which mujoco looks for the index of an EGL device."""

SOFTWARE = ("llvmpipe", "softpipe", "swrast", "swiftshader", "software")
"""Parts of the names of renderers that need no GPU."""

EGL_EXTENSIONS = 0x3055

_gl_process: int | None = None
"""Process that has used OpenGL first, here or in a parent."""


@dataclass(frozen=True)
class OpenGL:
    """What draws the pictures.

    Attributes:
        backend: of mujoco, for example `egl`.
        renderer: name of the device or program that draws, for example `llvmpipe (LLVM 15.0.6, 256 bits)`.
        vendor: who made the driver.
        version: of OpenGL and of the driver.
    """

    backend: str
    renderer: str
    vendor: str
    version: str

    @property
    def software(self) -> bool:
        """Whether it draws on the processor; no GPU is needed then."""
        return is_software(self.renderer)


def is_software(renderer: str) -> bool:
    """Whether a renderer of this name draws on the processor."""
    return any(each in renderer.lower() for each in SOFTWARE)


def has_egl() -> bool:
    """Whether EGL can be loaded, and OpenGL beside it by one of the names that PyOpenGL tries (Linux only)."""
    return _loadable("libEGL.so.1") and any(map(_loadable, ("libOpenGL.so.0", "libGL.so.1")))


def has_osmesa() -> bool:
    """Whether OSMesa can be loaded, Mesa's rendering into plain memory (Linux only)."""
    return any(map(_loadable, ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")))


def _loadable(library: str) -> bool:
    if not sys.platform.startswith("linux"):
        return False
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def choose_backend() -> str:
    """Settle `MUJOCO_GL` before `mujoco` or `dm_control` reads it, and return it.

    On Linux an unset variable becomes `egl`, which needs no display. Where it says `egl` (or nothing) and there is no
    EGL library, importing mujoco or dm_control would fail: it becomes `osmesa` if that can be loaded. If neither can,
    it becomes `disabled`: physics works, and the first picture raises an error that says what to install. Other
    values are the user's choice; on other systems nothing is touched.
    """
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    if sys.platform.startswith("linux") and chosen in ("", "egl"):
        chosen = "egl" if has_egl() else "osmesa" if has_osmesa() else "disabled"
        os.environ["MUJOCO_GL"] = chosen
    return chosen


@contextmanager
def switched_off() -> Iterator[None]:
    """No OpenGL for what is imported meanwhile, which is meant for `dm_control`.

    It starts EGL when it is imported, and ends it at exit. Nothing here renders with it; without this, a
    machine without a working OpenGL could not even compose a model, and the others would wait a third of a second.
    """
    import mujoco  # noqa: F401  (it reads the variable too, and does render)

    before = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "disabled"
    try:
        yield
    finally:
        if before is None:
            del os.environ["MUJOCO_GL"]
        else:
            os.environ["MUJOCO_GL"] = before


def make_context(width: int, height: int) -> Any:
    """An off-screen OpenGL context of the chosen backend.

    Raises:
        RuntimeError: there is no OpenGL to render with; the message says what to install.
    """
    refuse_after_fork()
    backend = os.environ.get("MUJOCO_GL", "").strip().lower()
    if backend in OFF:
        raise RuntimeError(_switched_off(backend))
    try:
        return _context_class(backend)(width, height)
    except Exception as error:
        reason = " ".join(str(error).split()).rstrip(".")  # PyOpenGL's errors have many lines
        raise RuntimeError(
            f"cannot render: OpenGL (MUJOCO_GL={backend or 'unset'}) fails: {reason}.{_advice(backend)}"
        ) from error


def _context_class(backend: str) -> Any:
    """Class of the contexts; by name, because mujoco may have been imported before the backend was chosen."""
    if sys.platform.startswith("linux") and backend in ("", "egl"):
        _choose_device()
        from mujoco.egl import GLContext
    elif sys.platform.startswith("linux") and backend == "osmesa":
        from mujoco.osmesa import GLContext
    else:
        from mujoco.gl_context import GLContext
    return GLContext


def _switched_off(backend: str) -> str:
    """Why nothing is rendered with this value of `MUJOCO_GL`: by choice, or because nothing was found."""
    if not sys.platform.startswith("linux") or has_egl() or has_osmesa():
        return f"cannot render: MUJOCO_GL={backend} switches rendering off. Unset it"
    return (
        "cannot render: neither EGL (libEGL.so.1 with libOpenGL.so.0) nor OSMesa (libOSMesa.so.8) can be loaded."
        + _advice(backend)
    )


def _advice(backend: str) -> str:
    """What to do where rendering fails, as the end of a message."""
    if not sys.platform.startswith("linux"):
        return ""
    if backend != "osmesa" and has_osmesa():
        return f" Set MUJOCO_GL=osmesa; or, on Debian or Ubuntu, run: {REMEDY}"
    return f" On Debian or Ubuntu run: {REMEDY} (or, to render without EGL: {ALTERNATIVE})"


def _choose_device() -> None:
    """Have mujoco draw on a GPU where there is one, unless the user has chosen a device.

    mujoco takes the first EGL device that starts. A driver lists its GPUs before its software device, but the drivers
    themselves come in the order of their configuration files, so that Mesa's software may stand before another
    driver's GPU. Only then is anything changed.
    """
    if os.environ.get(DEVICE) is not None:
        return
    from mujoco import egl

    if egl.EGL_DISPLAY is not None:  # somebody has rendered already, and all contexts share one display
        return
    index = hidden_gpu(_device_extensions(), _starts)
    os.environ.pop(DEVICE, None)
    if index is not None:
        os.environ[DEVICE] = str(index)


def hidden_gpu(extensions: Sequence[str], starts: Callable[[int], bool]) -> int | None:
    """Index of the first GPU that starts, if a software device stands before it; None if the order is right as it is.

    Args:
        extensions: of every EGL device, in the driver's order.
        starts: whether the device of this index can be initialised.
    """
    software = ["software" in each for each in extensions]
    if True not in software or all(software[software.index(True) :]):
        return None
    return next((index for index, each in enumerate(software) if not each and starts(index)), None)


def _device_extensions() -> list[str]:
    """Extensions of every EGL device, in the order in which mujoco counts them."""
    from mujoco.egl import egl_ext

    address = egl_ext.eglGetProcAddress("eglQueryDeviceStringEXT")
    if not address:
        return []
    query = ctypes.CFUNCTYPE(ctypes.c_char_p, ctypes.c_void_p, ctypes.c_int)(address)
    return [(query(device, EGL_EXTENSIONS) or b"").decode() for device in egl_ext.eglQueryDevicesEXT()]


def _starts(index: int) -> bool:
    """Whether mujoco can initialise the EGL device `index`; leaves the variable set."""
    from mujoco import egl

    os.environ[DEVICE] = str(index)
    try:
        return egl.create_initialized_egl_device_display() != egl.EGL.EGL_NO_DISPLAY
    except Exception:  # of PyOpenGL, whatever the driver says
        return False


def refuse_after_fork() -> None:
    """Refuse OpenGL in a forked child of a process that has used it: without the driver's threads it would hang."""
    global _gl_process
    if _gl_process is None:
        _gl_process = os.getpid()
    if _gl_process != os.getpid():
        raise RuntimeError(
            "cannot render: this process was forked from one that had rendered already, in which OpenGL would hang. "
            "Start workers with the method 'spawn', for example gym.make_vec(..., vector_kwargs={'context': 'spawn'})"
        )


def describe_renderer() -> OpenGL:
    """Ask a context of the chosen backend what draws in it.

    Raises:
        RuntimeError: there is no OpenGL to render with; the message says what to install.
    """
    context = make_context(16, 16)
    try:
        context.make_current()
        from OpenGL import GL  # not before the context: PyOpenGL settles on a platform when it is imported

        names = [GL.glGetString(each) for each in (GL.GL_RENDERER, GL.GL_VENDOR, GL.GL_VERSION)]
    finally:
        context.free()
    renderer, vendor, version = ((name or b"unnamed").decode() for name in names)
    return OpenGL(os.environ.get("MUJOCO_GL") or "system OpenGL", renderer, vendor, version)
