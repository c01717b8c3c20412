"""Where a robot can stand and drive in a world: free space, passages, poses at rest, paths, and their maps."""

from __future__ import annotations

from rover_rl.sims.free_space.ground import rest_on_ground
from rover_rl.sims.free_space.space import FreeSpace, free_space

__all__ = ["FreeSpace", "free_space", "rest_on_ground"]
