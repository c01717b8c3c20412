"""Colors, light and goal post of all pictures. Colors are red, green and blue, 0 to 1, as a screen shows them."""

from __future__ import annotations

from typing import NamedTuple

from rover_rl.worlds.movers.mover import Person, Shape
from rover_rl.worlds.world import World

GROUND = (0.66, 0.57, 0.47)
"""Color of the ground."""
OBSTACLE = (0.50, 0.57, 0.65)
"""Color of obstacles. Each is a little darker or brighter."""
GOAL = (0.10, 0.75, 0.25)
"""Color of the post of the goal."""
CLOTHES = (0.47, 0.30, 0.66)
"""Color of the trunks of people."""
LEGS = (0.20, 0.18, 0.27)
"""Color of their legs."""
SKIN = (0.76, 0.58, 0.46)
"""Color of their heads."""
MOVER = (0.80, 0.24, 0.22)
"""Color of other movers."""
UNPAINTED = (0.70, 0.70, 0.72)
"""Color of the rover's visual shapes for which neither the URDF nor the mesh file states one."""
HORIZON = (0.87, 0.88, 0.88)
"""Color of the sky at the horizon, and of the haze."""
ZENITH = (0.30, 0.52, 0.80)
"""Color of the sky overhead."""
SUN = (-0.62, 0.42, 0.66)
"""Direction to the sun in the world frame."""
GRID = 1.0
"""Distance between the lines on the ground, m."""
POST_RADIUS = 0.08
"""Radius of the post of the goal, m."""
POST_LENGTH = 1.2
"""Length of the post of the goal, m."""


class Look(NamedTuple):
    """Color of a part (red, green and blue, 0 to 1), and whether it is drawn as the trunk and the head of a person."""

    color: tuple[float, float, float]
    is_figure: bool = False


def looks_of(world: World, count: int) -> list[Look]:
    """Returns the look of ``count`` parts: those of other rovers of a group, then those of a world's movers."""
    looks = [look for mover in world.movers for look in _looks(mover.shape)]
    return [*[Look(MOVER)] * (count - len(looks)), *looks][:count]


def _looks(shape: Shape) -> list[Look]:
    if isinstance(shape, Person):
        return [Look(LEGS), Look(LEGS), Look(CLOTHES, True)]
    return [Look(MOVER) for _ in shape.parts()]
