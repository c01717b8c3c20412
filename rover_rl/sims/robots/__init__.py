"""Robots: a URDF and one dataclass of figures each."""

from __future__ import annotations

from collections.abc import Callable

from rover_rl.registry import Registry
from rover_rl.sims.robots.robot import Robot
from rover_rl.sims.robots.rover_zero import ROVER_ZERO

ROBOTS: dict[str, Robot] = {ROVER_ZERO.name: ROVER_ZERO}
"""The robots that come with the package, by name."""


_REGISTRY = Registry("robot", ROBOTS, also=", a Robot, or 'module:attribute' of your own")


def register_robot(name: str, robot: Robot | Callable[[], Robot] | str) -> None:
    """Gives a robot a name, for ``RoverEnv``, ``EnvConfig`` and ``--robot``.

    Args:
        name: its name.
        robot: the robot, a function that makes it, or the ``"module:attribute"`` of either.

    Raises:
        ValueError: for a name that is taken, or that has other characters than letters, digits, ``_``, ``-`` and ``.``.
    """
    _REGISTRY.register(name, robot)


def robot_names() -> list[str]:
    """Names of the robots of the package, of those registered, and of those of installed packages."""
    return _REGISTRY.names()


def get_robot(robot: str | Robot) -> Robot:
    """The robot of that name, or the one given.

    Args:
        robot: a name in :func:`robot_names`, or the ``module:attribute`` of a robot of your own or of a function that
            makes it.

    Raises:
        ValueError: for a name of no robot.
    """
    if isinstance(robot, Robot):
        return robot
    part = _REGISTRY.find(robot)
    part = part() if callable(part) else part
    if not isinstance(part, Robot):
        raise ValueError(f"robot {robot!r} must be a Robot or a function that returns one, got {type(part).__name__}")
    return part


__all__ = ["ROBOTS", "Robot", "get_robot", "register_robot", "robot_names"]
