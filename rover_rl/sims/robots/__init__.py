"""Robots: a body, which a URDF describes, a drive and sensors each.

``Robot`` needs PyTorch and is imported on first use.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rover_rl.registry import Registry
from rover_rl.sims.robots.options import LIDAR_OPTIONS, RobotOptions, is_robot_file, split_options

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


_REGISTRY = Registry("robot", ROBOTS, also=", a URDF file, a Robot, or 'module:attribute' of your own")


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
        robot: name in :func:`robot_names`, path of a URDF (``"scout.urdf"``), ``"module:attribute"`` of a robot or of a
            function that returns one, or a robot. A name may have options, as in
            ``"scout.urdf,drive=skid_steer,max_speed=1.5"``: the fields of :class:`RobotOptions`.

    Raises:
        ValueError: if the name is unknown, or refers to something else than a robot; if a URDF holds no robot that can
            be driven, or an option does not fit the robot.
        FileNotFoundError: if there is no such file.
    """
    from rover_rl.sims.robots.robot import Robot

    if isinstance(robot, Robot):
        return robot
    if not isinstance(robot, str):
        raise ValueError(f"robot must be a name or a Robot, got {type(robot).__name__} {robot!r}"[:200])
    own, options = split_options(robot)
    if is_robot_file(own):
        path = Path(own)
        return _read(path, options, path.stat().st_mtime_ns if path.is_file() else 0)
    return _with_limits(_named(own), options)


@lru_cache(maxsize=16)
def _read(path: Path, options: RobotOptions, modified: int) -> Robot:
    """Returns the robot in a URDF. ``modified`` is the time of the last change of the file."""
    from rover_rl.sims.robots.robot import Robot

    return Robot.from_urdf(path, options=options)


def _with_limits(robot: Robot, options: RobotOptions) -> Robot:
    """Returns a robot of another name than a file with options, of which it takes those on its drive and lidar."""
    if options == RobotOptions():
        return robot
    drive: dict[str, Any] = {}
    for option in options.given:
        field = _FIELDS.get(option, option)
        if option in LIDAR_OPTIONS:
            continue
        if not hasattr(robot.drive, field) or option in ("drive", "missing"):
            raise ValueError(
                f"option {option} does not fit robot {robot.name!r}, whose drive is a {type(robot.drive).__name__}"
            )
        drive[field] = getattr(options, option)
    changes: dict[str, Any] = {"drive": replace(robot.drive, **drive), **options.lidar_settings}
    if options.lidar is not None:
        place = options.lidar.split()
        changes["lidar"] = tuple(map(float, place)) if len(place) == 3 else options.lidar
    return replace(robot, **changes)


_FIELDS = {"max_acceleration": "max_linear_acceleration"}
"""Fields of a drive that options set, where the names differ."""


def _named(robot: str) -> Robot:
    """Returns a robot by its name, without options."""
    from rover_rl.sims.robots.robot import Robot

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


__all__ = ["ROBOTS", "Robot", "RobotOptions", "get_robot", "register_robot", "robot_names"]
