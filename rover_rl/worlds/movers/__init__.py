"""Movers: obstacles and people that move, their shapes and their motions."""

from __future__ import annotations

from rover_rl.worlds.movers.motions import (
    Courses,
    Cross,
    Door,
    Motion,
    Orca,
    Scene,
    Slider,
    SocialForce,
    Wander,
    Waypoints,
)
from rover_rl.worlds.movers.mover import Mover
from rover_rl.worlds.movers.shapes import Box, Capsule, Cylinder, Part, Person, Shape

__all__ = [
    "Box",
    "Capsule",
    "Courses",
    "Cross",
    "Cylinder",
    "Door",
    "Motion",
    "Mover",
    "Orca",
    "Part",
    "Person",
    "Scene",
    "Shape",
    "Slider",
    "SocialForce",
    "Wander",
    "Waypoints",
]
