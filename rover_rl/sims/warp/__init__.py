"""The Warp backend: a simulator made for this rover, on the CPU or a GPU, about twenty times as fast as Bullet.

Importing this needs no Warp; making a simulator does.
"""

from __future__ import annotations

from rover_rl.sims.warp.settings import WarpSettings

__all__ = ["WarpSettings"]
