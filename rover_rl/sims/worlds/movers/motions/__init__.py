"""Motions of movers, a file each."""

from __future__ import annotations

from rover_rl.sims.worlds.movers.motions.base import Course, Motion, Scene
from rover_rl.sims.worlds.movers.motions.cross import Cross
from rover_rl.sims.worlds.movers.motions.walks import Walk
from rover_rl.sims.worlds.movers.motions.wander import Wander
from rover_rl.sims.worlds.movers.motions.waypoints import Waypoints

__all__ = ["Course", "Cross", "Motion", "Scene", "Walk", "Wander", "Waypoints"]
