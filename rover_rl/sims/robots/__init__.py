"""Robots: a body, which a URDF describes, a drive and sensors each.

``Robot`` needs PyTorch and is imported on first use.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rover_rl.registry import Registry

if TYPE_CHECKING:
    from rover_rl.sims.robots.robot import Robot

ROBOTS = {
    "rover_zero": "rover_rl.sims.robots.rover_zero:ROVER_ZERO",
    "leo": "rover_rl.sims.robots.leo:LEO",
    "jackal": "rover_rl.sims.robots.jackal:JACKAL",
    "husky": "rover_rl.sims.robots.husky:HUSKY",
    "racer": "rover_rl.sims.robots.racer:RACER",
    "hunter": "rover_rl.sims.robots.hunter:HUNTER",
}
"""Built-in robots, by name."""


_REGISTRY = Registry("robot", ROBOTS, also=", a Robot, or 'module:attribute' of your own")


def register_robot(name: str, robot: Robot | Callable[[], Robot] | str) -> None:
    """Registers a robot under a name, for ``RoverEnv``, ``EnvConfig`` and ``--robot``.

    Args:
        name: new name of letters, digits, ``_``, ``-`` and ``.``.
        robot: robot, function that returns a robot, or ``"module:attribute"`` of either.

    Raises:
        ValueError: if the name is taken or has other characters.
    """
    _REGISTRY.register(name, robot)


def robot_names() -> list[str]:
    """Returns the names of all robots: built-in, registered, and from installed packages."""
    return _REGISTRY.names()


def get_robot(robot: str | Robot) -> Robot:
    """Returns a robot by name. Returns a :class:`Robot` unchanged.

    Args:
        robot: name in :func:`robot_names`, ``"module:attribute"`` of a robot or of a function that returns one, or a
            robot.

    Raises:
        ValueError: if the name is unknown, or refers to something else than a robot.
    """
    from rover_rl.sims.robots.robot import Robot

    if isinstance(robot, Robot):
        return robot
    if not isinstance(robot, str):
        raise ValueError(f"robot must be a name or a Robot, got {type(robot).__name__} {robot!r}"[:200])
    part = _REGISTRY.find(robot)
    part = _REGISTRY.call(robot, part) if callable(part) else part
    if not isinstance(part, Robot):
        raise ValueError(f"robot {robot!r} must be a Robot or a function that returns one, got {type(part).__name__}")
    return part


def __getattr__(name: str) -> Any:
    if name != "Robot":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from rover_rl.sims.robots.robot import Robot

    return Robot


__all__ = ["ROBOTS", "Robot", "get_robot", "register_robot", "robot_names"]
