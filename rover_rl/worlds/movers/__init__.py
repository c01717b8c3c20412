"""Movers: obstacles and people that move, their shapes and their motions."""

from rover_rl.worlds.movers.motion import Motion, MotionInput, MoverState, Rovers, WallDistances
from rover_rl.worlds.movers.mover import Box, Capsule, Cylinder, Mover, Part, Person, Shape
from rover_rl.worlds.movers.walks import Cross, Orca, SocialForce, Walk, Wander
from rover_rl.worlds.movers.waypoints import Waypoints

__all__ = ["Cross", "Motion", "MotionInput", "MoverState", "Orca", "Rovers", "SocialForce", "Walk", "WallDistances"]
__all__ += ["Box", "Capsule", "Cylinder", "Mover", "Part", "Person", "Shape", "Wander", "Waypoints"]
