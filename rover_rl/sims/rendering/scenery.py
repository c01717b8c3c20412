"""Colors, light and goal post of all pictures. Colors are red, green and blue, 0 to 1, as a screen shows them."""

from __future__ import annotations

from typing import NamedTuple

from rover_rl.worlds.movers.mover import Person
from rover_rl.worlds.world import World

GROUND = (0.66, 0.57, 0.47)
"""Color of the ground."""
OBSTACLE = (0.50, 0.57, 0.65)
"""Color of obstacles. Each is a little darker or brighter."""
GOAL = (0.10, 0.75, 0.25)
"""Color of the post of the goal."""
CLOTHES, LEGS, SKIN = (0.47, 0.30, 0.66), (0.20, 0.18, 0.27), (0.76, 0.58, 0.46)
"""Colors of the trunks, the legs and the heads of people."""
MOVER = (0.80, 0.24, 0.22)
"""Color of other movers."""
UNPAINTED = (0.70, 0.70, 0.72)
"""Color of the rover's visual shapes for which neither the URDF nor the mesh file states one."""
HORIZON, ZENITH = (0.87, 0.88, 0.88), (0.30, 0.52, 0.80)
"""Colors of the sky: at the horizon, also of the haze, and overhead."""
SUN = (-0.62, 0.42, 0.66)
"""Direction to the sun in the world frame."""
GRID = 1.0
"""Distance between the lines on the ground, m."""
POST_RADIUS, POST_LENGTH = 0.08, 1.2
"""Size of the post of the goal, m."""


class Look(NamedTuple):
    """Color of a part (red, green and blue, 0 to 1), and whether it is drawn as the trunk and the head of a person."""

    color: tuple[float, float, float]
    is_figure: bool = False


def looks_of(world: World, count: int) -> list[Look]:
    """Returns the look of ``count`` parts: those of other rovers of a group, then those of a world's movers."""
    looks = []
    for shape in (mover.shape for mover in world.movers):
        person = [Look(LEGS), Look(LEGS), Look(CLOTHES, True)]
        looks += person if isinstance(shape, Person) else [Look(MOVER)] * len(shape.parts())
    return [*[Look(MOVER)] * (count - len(looks)), *looks][:count]
