"""An OpenGL context without a window.

MuJoCo reads MUJOCO_GL when it is imported, and by then nobody has asked for a picture. So the context is made here, when the
first one is wanted, by MuJoCo's own backends.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import platform
from typing import Any

from service.errors import TandemError

_LIBRARIES = {"egl": ("libEGL.so.1", "libEGL.so"), "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")}
_OFF = ("disable", "disabled", "off", "false", "0")
_SYSTEM_DEFAULT = ("", "enable", "enabled", "on", "true", "1")
_HELP = (
    "for pictures install an OpenGL without a window (Debian and Ubuntu: apt-get install libegl1 libgl1, or libosmesa6 and "
    "MUJOCO_GL=osmesa); training works without it"
)


class RenderError(TandemError):
    """This machine cannot draw; the message says what is missing."""


def requested_backend() -> str:
    """MUJOCO_GL as MuJoCo reads it; empty when nothing is asked for."""
    return os.environ.get("MUJOCO_GL", "").lower().strip()


def open_context(width: int, height: int) -> Any:
    """Make an offscreen OpenGL context and make it current.

    The backend is MUJOCO_GL's; without it EGL, which needs no display, or OSMesa, or a hidden window, the first whose
    library is there.

    Returns:
        A ``GLContext`` of MuJoCo, with ``make_current`` and ``free``.

    Raises:
        RenderError: no OpenGL here, or MUJOCO_GL turns it off.
    """
    backend = _choose()
    try:
        context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        if getattr(context, "_context", context) is None:
            raise RenderError(f"no picture: no window could be opened for MUJOCO_GL={backend}; {_HELP}")
        context.make_current()
    except RenderError:
        raise
    except Exception as error:  # every backend fails in its own way: ImportError, AttributeError, RuntimeError, EGLError
        reason = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
        raise RenderError(f"no picture: OpenGL by {backend} failed ({reason}); {_HELP}") from error
    return context


def _choose() -> str:
    requested = requested_backend()
    if requested in _OFF:
        raise RenderError(f"no picture: MUJOCO_GL={requested} turns rendering off; unset it")
    if requested in ("egl", "osmesa", "cgl", "glfw"):
        return requested
    if requested not in (*_SYSTEM_DEFAULT, "glx", "wgl"):
        raise RenderError(f"no picture: MUJOCO_GL={requested} is no backend; unset it, or set egl or osmesa")
    if platform.system() == "Darwin":
        return "cgl"
    if platform.system() == "Linux" and requested in _SYSTEM_DEFAULT:
        return next((backend for backend in _LIBRARIES if _is_installed(backend)), "glfw")
    return "glfw"


def _is_installed(backend: str) -> bool:
    for name in _LIBRARIES[backend]:
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False
