"""PyBullet, imported without the output that its C library prints to stdout and stderr."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterable

from rover_rl.native.output import native_output_silenced

try:
    with native_output_silenced():
        import pybullet
except ImportError as error:
    raise ImportError(
        "PyBullet is not installed: pip install 'rover_rl[bullet]', which compiles PyBullet where it has no wheels, or "
        "use the backends 'warp' or 'mujoco', which run without it"
    ) from error

# Only the C library of Linux (glibc) has this function.
_return_free_memory = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None


def disconnect(clients: Iterable[int]) -> None:
    """Disconnects the connected ones of ``clients`` and returns their memory to the system.

    Without this, the C library keeps up to 80 MB for later use.
    """
    for client in clients:
        if pybullet.isConnected(client):
            pybullet.disconnect(client)
    if _return_free_memory is not None:
        _return_free_memory(0)


__all__ = ["disconnect", "pybullet"]
