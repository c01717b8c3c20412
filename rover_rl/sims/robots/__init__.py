"""Robots: a URDF and one dataclass of figures each."""

from __future__ import annotations

from rover_rl.sims.robots.robot import Robot
from rover_rl.sims.robots.rover_zero import ROVER_ZERO

ROBOTS: dict[str, Robot] = {ROVER_ZERO.name: ROVER_ZERO}
"""The robots that come with the package, by name."""


def get_robot(robot: str | Robot) -> Robot:
    """The robot of that name, or the one given.

    Raises:
        ValueError: for a name that is not in :data:`ROBOTS`.
    """
    if isinstance(robot, Robot):
        return robot
    if robot not in ROBOTS:
        raise ValueError(f"unknown robot {robot!r}; use one of {sorted(ROBOTS)} or a Robot")
    return ROBOTS[robot]


__all__ = ["ROBOTS", "Robot", "get_robot"]
