"""MuJoCo, imported with an OpenGL library that needs no display, if there is none. Clear error if not installed."""

from __future__ import annotations

import ctypes
import os
import sys

_OFFSCREEN = {"egl": "libEGL.so.1", "osmesa": "libOSMesa.so.8"}
"""OpenGL libraries for rendering without a display on Linux: names of MUJOCO_GL and files."""


def _offscreen_library() -> str | None:
    """Returns the name of an installed library of :data:`_OFFSCREEN`, if pictures need one."""
    displays = ("DISPLAY", "WAYLAND_DISPLAY")
    if sys.platform == "linux" and not any(map(os.environ.get, (*displays, "MUJOCO_GL"))):
        for name, file in _OFFSCREEN.items():
            try:
                ctypes.CDLL(file)
            except OSError:
                continue
            return name
    return None


# MuJoCo reads this variable when it is imported.
if _library := _offscreen_library():
    os.environ["MUJOCO_GL"] = _library

try:
    import mujoco
    from mujoco.rollout import Rollout
except ImportError as error:
    raise ImportError("backend='mujoco' needs MuJoCo: pip install 'rover_rl[mujoco]'") from error

__all__ = ["Rollout", "mujoco"]
