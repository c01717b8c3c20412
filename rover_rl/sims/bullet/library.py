"""PyBullet, imported without the lines that its C library prints to the process's stdout and stderr."""

from __future__ import annotations

from rover_rl.sims.native import native_output_silenced

with native_output_silenced():
    import pybullet

__all__ = ["pybullet"]
