"""Motions of movers, a file each."""

from __future__ import annotations

from rover_rl.worlds.movers.motions.base import Courses, Motion, Scene
from rover_rl.worlds.movers.motions.cross import Cross
from rover_rl.worlds.movers.motions.door import Door
from rover_rl.worlds.movers.motions.orca import Orca
from rover_rl.worlds.movers.motions.slider import Slider
from rover_rl.worlds.movers.motions.social_force import SocialForce
from rover_rl.worlds.movers.motions.walks import Walk
from rover_rl.worlds.movers.motions.wander import Wander
from rover_rl.worlds.movers.motions.waypoints import Waypoints

__all__ = [
    "Courses",
    "Cross",
    "Door",
    "Motion",
    "Orca",
    "Scene",
    "Slider",
    "SocialForce",
    "Walk",
    "Wander",
    "Waypoints",
]
