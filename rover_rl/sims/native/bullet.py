"""PyBullet, imported without the lines that its C library prints to the process's stdout and stderr."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable

from rover_rl.sims.native.output import native_output_silenced

with native_output_silenced():
    import pybullet

# In the C library of Linux (glibc) alone; others have no function of this name.
_return_free_memory = getattr(ctypes.CDLL(None), "malloc_trim", None)


def disconnect(clients: Iterable[int]) -> None:
    """Disconnects those of ``clients`` that are connected, and returns their memory to the system.

    The C library would keep up to 80 MB of it for later, more or less by chance.
    """
    for client in clients:
        if pybullet.isConnected(client):
            pybullet.disconnect(client)
    if _return_free_memory is not None:
        _return_free_memory(0)


__all__ = ["disconnect", "pybullet"]
