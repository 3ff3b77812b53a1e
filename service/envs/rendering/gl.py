"""An OpenGL context without a window.

MuJoCo chooses its OpenGL backend by MUJOCO_GL when it is imported, long before anybody asks for a picture, and fails to
import where that backend's library is missing. So the context is made here, when the first picture is wanted, out of
MuJoCo's own backends.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import platform
import warnings
from typing import TYPE_CHECKING, Any

from service.base.errors import TandemError

if TYPE_CHECKING:
    import mujoco

_LIBRARIES = {"egl": ("libEGL.so.1", "libEGL.so"), "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")}
_OFF = ("disable", "disabled", "off", "false", "0")
_ANY = ("", "enable", "enabled", "on", "true", "1")
_BACKENDS = {"Linux": ("egl", "osmesa", "glfw", "glx"), "Darwin": ("cgl", "glfw")}
_INSTALL = (
    "install an OpenGL that needs no window (Debian, Ubuntu: apt-get install libegl1 libgl1, or libosmesa6 and "
    "MUJOCO_GL=osmesa); only pictures and videos need it, training works without"
)
_refused: list[str] = []
"""The value of MUJOCO_GL that ``protect_import`` put aside, if any."""


def protect_import() -> None:
    """Let ``import mujoco`` succeed whatever MUJOCO_GL says: training draws nothing and must not fail for it.

    A MUJOCO_GL that would break the import is put aside, and named when a picture is asked for. Call before the import.
    """
    requested = _requested()
    known = (*_OFF, *_ANY, *_BACKENDS.get(platform.system(), ()))
    if requested not in known or (requested in _LIBRARIES and not _is_installed(requested)):
        os.environ["MUJOCO_GL"] = "disable"
        _refused.append(requested)


def open_drawing(model: mujoco.MjModel, width: int, height: int) -> tuple[Any, mujoco.MjrContext]:
    """Make an OpenGL context that needs no window, make it current, and load a model's shapes and textures into it.

    The backend is MUJOCO_GL's. Without it on Linux: EGL, OSMesa or a hidden window, the first whose library is there.

    Returns:
        A ``GLContext`` of MuJoCo, with ``make_current`` and ``free``, and what ``mjr_render`` draws with.

    Raises:
        TandemError: no OpenGL here, or MUJOCO_GL turns it off.
    """
    import mujoco  # not above: this module goes before it

    backend = _choose()
    try:
        with warnings.catch_warnings(action="ignore"):  # glfw warns where the error below says it
            context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        if not getattr(context, "_context", True):
            raise RuntimeError("no window could be opened")
        context.make_current()
        drawing = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, drawing)
    except Exception as error:  # ImportError, AttributeError, RuntimeError, GLError: every backend fails in its own way
        reason = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
        raise TandemError(f"cannot draw: OpenGL by {backend} failed ({reason}); {_INSTALL}") from error
    return context, drawing


def _requested() -> str:
    return os.environ.get("MUJOCO_GL", "").lower().strip()


def _choose() -> str:
    if _refused:
        raise TandemError(f"cannot draw: MUJOCO_GL={_refused[0]} names no OpenGL that is here; unset it, or {_INSTALL}")
    requested = _requested()
    if requested in _OFF:
        raise TandemError(f"cannot draw: MUJOCO_GL={requested} turns rendering off; unset it")
    if requested not in _ANY:
        return "glfw" if requested == "glx" else requested
    backends = _BACKENDS.get(platform.system(), ("glfw",))
    return next(backend for backend in backends if backend not in _LIBRARIES or _is_installed(backend))


def _is_installed(backend: str) -> bool:
    for name in _LIBRARIES[backend]:
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False
