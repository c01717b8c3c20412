"""How the parts of movers look in pictures and on maps."""

from __future__ import annotations

from typing import NamedTuple

from rover_rl.sims.rendering.scenery import CLOTHES, LEGS, MOVER
from rover_rl.worlds.movers.mover import Person, Shape
from rover_rl.worlds.world import World


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
