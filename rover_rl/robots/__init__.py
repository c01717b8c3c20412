"""Robots: a body, which a URDF describes, a drive and sensors each.

``Robot`` needs PyTorch and is imported on first use.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from rover_rl.registry import Registry
from rover_rl.robots.options import LIDAR_OPTIONS, RobotOptions, is_robot_file, split_options

if TYPE_CHECKING:
    from rover_rl.robots.robot import Robot

    RobotSource: TypeAlias = str | Robot | Sequence[str | Robot]

ROBOTS = {
    "rover_zero": "rover_rl.robots.built_in:ROVER_ZERO",
    "leo": "rover_rl.robots.built_in:LEO",
    "jackal": "rover_rl.robots.built_in:JACKAL",
    "husky": "rover_rl.robots.built_in:HUSKY",
    "racer": "rover_rl.robots.built_in:RACER",
    "hunter": "rover_rl.robots.built_in:HUNTER",
}
"""Built-in robots, by name."""
FAMILIES = {"any": "rover_rl.robots.any_robot:any_robot"}
"""Built-in families of robots, functions of a seed, by name."""


TRAINING_SEEDS = 10_000
"""Number of seeds of a family for training, from 0. By convention, seeds from 10,000 up are for evaluation."""

_MEMBER = re.compile(r"(.+):([0-9]+)", re.ASCII)
_RANGE = re.compile(r"([^,]+):([0-9]+)-([0-9]+)(,.*)?", re.ASCII)
_REGISTRY = Registry("robot", ROBOTS | FAMILIES, also=", a URDF file, a Robot, or 'module:attribute' of your own")


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
    """Returns the names of all robots and families: built-in, registered, and from installed packages."""
    return _REGISTRY.names()


def names_several(robots: RobotSource) -> bool:
    """Whether robots are given by a range of seeds, or a list of more than one."""
    if isinstance(robots, str):
        return _RANGE.fullmatch(robots) is not None
    return isinstance(robots, Sequence) and (len(robots) > 1 or any(map(names_several, robots)))


def get_robot(robot: RobotSource) -> Robot:
    """Returns a robot by name. Returns a :class:`Robot` unchanged.

    Args:
        robot: name in :func:`robot_names`, path of a URDF (``"scout.urdf"``), ``"module:attribute"`` of a robot or of a
            function that returns one, or a robot. A suffix ``:seed`` selects a robot of a family, a function of a seed:
            ``"any:17"``. A name may have options, as in ``"scout.urdf,drive=skid_steer,max_speed=1.5"``: the fields of
            :class:`RobotOptions`.

    Raises:
        ValueError: if the name is unknown, that of a range, or refers to something else than a robot; if a URDF holds
            no robot that can be driven, or an option does not fit the robot.
        FileNotFoundError: if there is no such file.
    """
    from rover_rl.robots.robot import Robot

    if names_several(robot):
        names = f"{robot!r}"[:120]
        raise ValueError(f"{names} names several robots, and one is needed here: name it, as with --robot jackal")
    if isinstance(robot, (list, tuple)) and robot:
        (robot,) = robot
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
    from rover_rl.robots.robot import Robot

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
        if len(place) != 3:
            raise ValueError(f'lidar of robot {robot.name!r} must be "x y z", got {options.lidar!r}')
        changes["lidar_position"] = tuple(map(float, place))
    return replace(robot, **changes)


_FIELDS = {"max_acceleration": "max_linear_acceleration"}
"""Fields of a drive that options set, where the names differ."""


def _named(robot: str) -> Robot:
    """Returns a robot by its name, without options."""
    from rover_rl.robots.robot import Robot

    name, seed = robot, ""
    if _MEMBER.fullmatch(robot):
        name, _, seed = robot.rpartition(":")
    part = _REGISTRY.find(name)
    if seed and not callable(part):
        raise ValueError(f"robot {robot!r} has a seed, and {name!r} is one robot, not a family")
    part = _REGISTRY.call(robot, part, *map(int, filter(None, [seed]))) if callable(part) else part
    if not isinstance(part, Robot):
        raise ValueError(f"robot {robot!r} must be a Robot or a function that returns one, got {type(part).__name__}")
    return part


def get_robots(robots: RobotSource) -> tuple[Robot, ...]:
    """Returns the robots that episodes draw from, each once.

    Args:
        robots: robot, its name, a range of seeds of a family (``"any:0-255"``), or a list of them.

    Raises:
        ValueError: as :func:`get_robot`, or if there are no robots or too many, or a range is not in order.
    """
    from rover_rl.robots.fleet import MAX_ROBOTS

    entries = [robots] if isinstance(robots, str) or not isinstance(robots, Sequence) else robots
    names = [name for entry in entries for name in _members(entry)]
    if not 1 <= len(names) <= MAX_ROBOTS:
        raise ValueError(f"robot must give 1 to {MAX_ROBOTS} robots, as 'any:0-255' does, got {len(names)}")
    return tuple(dict.fromkeys(map(get_robot, names)))


def check_training_robots(robots: RobotSource) -> None:
    """Raises a ``ValueError`` if robots are unknown, or one is for evaluation: has a seed of 10,000 or more."""
    for robot in get_robots(robots):
        match = _MEMBER.fullmatch(robot.name)
        if match is not None and int(match[2]) >= TRAINING_SEEDS:
            raise ValueError(
                f"robots with seeds from {TRAINING_SEEDS} up are for evaluation; train with lower ones, as in "
                f"'{match[1]}:0-255', got {robot.name!r}"
            )


def _members(entry: str | Robot) -> Sequence[str | Robot]:
    """Returns the names of the robots of a range, or the only entry."""
    match = _RANGE.fullmatch(entry) if isinstance(entry, str) else None
    if match is None:
        return [entry]
    family, first, last = match[1], int(match[2]), int(match[3])
    if last < first:
        raise ValueError(f"the ends of {entry!r} must be in order, as in '{family}:0-255'")
    return [f"{family}:{seed}{match[4] or ''}" for seed in range(first, min(last, first + 10_000) + 1)]


def __getattr__(name: str) -> Any:
    if name != "Robot":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from rover_rl.robots.robot import Robot

    return Robot


__all__ = [
    "FAMILIES",
    "ROBOTS",
    "Robot",
    "RobotOptions",
    "check_training_robots",
    "get_robot",
    "get_robots",
    "names_several",
    "register_robot",
    "robot_names",
]
