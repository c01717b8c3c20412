"""Worlds that fit a robot: the scale of passages that it needs, and the names of worlds with it.

Generated worlds have passages for Rover Zero, which needs a disc of 0.35 m. A larger robot needs the same layout,
wider, and so does a car, which cannot turn in place.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar

from rover_rl.robots import Robot
from rover_rl.worlds import World, takes_scale
from rover_rl.worlds.names import SCALES
from rover_rl.worlds.pool import WorldPool

Source = TypeVar("Source")

DISC = 0.35
"""Radius of the disc that generated worlds have room for, m: that of Rover Zero."""
CORRIDOR = 1.0
"""Width of the narrowest corridors of a maze of the default difficulty, m."""


def passage_scale(robot: Robot, radius: float | None = None) -> float:
    """Returns the scale of generated worlds that fit a robot: 1 or more, in steps of 0.1.

    The disc of the robot fits as that of Rover Zero does. In a corridor of a maze, a robot that does not turn in place
    has room for its disc on both sides of a turning circle's radius, in which it can turn around in three parts. One
    whose lidar does not see behind has room for its whole turning circle, and need not drive backward.

    Args:
        robot: robot.
        radius: radius of its disc, m. ``None``: ``robot.radius``.

    Raises:
        ValueError: if it would be more than 10.
    """
    radius = robot.radius if radius is None else radius
    circle = robot.drive.min_radius(robot.wheels) * (1 if robot.sees_behind else 2)
    turning = circle + 2 * radius
    needed = max(radius / DISC, 0.0 if robot.drive.turns_in_place else turning / CORRIDOR)
    scale = max(1.0, math.ceil(10 * needed - 1e-6) / 10)
    if scale > SCALES[1]:
        raise ValueError(
            f"robot {robot.name!r} with a radius of {radius:g} m is too large for generated worlds, "
            f"which would be {scale:g} times as large as for Rover Zero; {SCALES[1]} times is the most"
        )
    return scale


def fitting_worlds(worlds: Source, *robots: Robot) -> Source:
    """Returns worlds with passages wide enough for a robot, or for all of several, where that is left open.

    Names of generated worlds without a scale get that of the robot: ``"maze:5"`` becomes ``"maze:5*1.8"``. Worlds that
    have no scale, such as those of files, and names that state one, as in ``"maze:5*1"``, stay as they are.

    Args:
        worlds: world, name, list of both, or pool.
        robots: robots.

    Raises:
        ValueError: if a world is unknown, or a robot is too large for any scale.
    """
    return _fitted(worlds, max(map(passage_scale, robots)))


def _fitted(worlds: Any, scale: float) -> Any:
    if isinstance(worlds, World):
        return worlds
    if not isinstance(worlds, str):
        entries = worlds.entries if isinstance(worlds, WorldPool) else worlds
        fitted = [_fitted(entry, scale) for entry in entries]
        if all(a is b for a, b in zip(fitted, entries, strict=True)):
            return worlds
        return WorldPool(*fitted) if isinstance(worlds, WorldPool) else type(worlds)(fitted)
    if scale == 1 or not takes_scale(worlds):
        return worlds
    return f"{worlds}*{scale:g}"
