"""Warp backend: a simulator specialized for this rover, for CPUs and NVIDIA GPUs; see ``docs/warp.md``.

Importing this module does not require Warp; building a simulator does.
"""

from __future__ import annotations

from rover_rl.sims.warp.settings import WarpSettings

__all__ = ["WarpSettings"]
