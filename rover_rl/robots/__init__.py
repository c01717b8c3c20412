"""Robots: each has a body, which a URDF describes, a drive and sensors. ``Robot`` is imported on first use."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from rover_rl.names import TRAINING_SEEDS, Name
from rover_rl.registry import Registry
from rover_rl.robots.options import LIDAR_OPTIONS, RobotOptions, split_options

if TYPE_CHECKING:
    from rover_rl.robots.robot import Robot

    RobotSource: TypeAlias = str | Robot | Sequence[str | Robot]

ROBOTS = {
    name: f"rover_rl.robots.built_in:{name.upper()}"
    for name in ("rover_zero", "leo", "jackal", "husky", "racer", "hunter")
}
"""Built-in robots, by name."""
FAMILIES = {"any": "rover_rl.robots.any_robot:any_robot"}
"""Built-in families of robots, functions of a seed, by name."""
FILES = (".urdf", ".xacro", ".sdf", ".xml")
"""Endings of the files that are taken for a robot. Only a URDF can be read; the others are refused with advice."""

_REGISTRY = Registry("robot", ROBOTS | FAMILIES, also=", a URDF file, a Robot, or 'module:attribute' of your own")


def register_robot(name: str, robot: Robot | Callable[[], Robot] | str) -> None:
    """Registers a robot, a function that returns one, or ``"module:attribute"`` of either under a new name.

    Raises:
        ValueError: if the name is taken or has other characters than letters, digits, ``_``, ``-`` and ``.``.
    """
    _REGISTRY.register(name, robot)


def robot_names() -> list[str]:
    """Returns the names of all robots and families: built-in, registered, and from installed packages."""
    return _REGISTRY.names()


def names_several(robots: RobotSource) -> bool:
    """Whether robots are given by a range of seeds, or a list of more than one."""
    if isinstance(robots, str):
        return Name.parse(robots).is_range
    return isinstance(robots, Sequence) and (len(robots) > 1 or any(map(names_several, robots)))


def get_robot(robot: RobotSource) -> Robot:
    """Returns a robot by name. Returns a :class:`Robot` unchanged.

    A name is one of :func:`robot_names`, the path of a URDF, or ``"module:attribute"`` of a robot or of a function that
    returns one. ``"any:17"`` is a robot of a family, a function of a seed. A name may have the fields of
    :class:`RobotOptions` as settings: ``"scout.urdf(drive=skid_steer, max_speed=1.5)"``.

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
    part, seed, options = split_options(robot)
    if part.lower().endswith(FILES) and seed is None:
        path = Path(part)
        return _read(path, options, path.stat().st_mtime_ns if path.is_file() else 0)
    found = _REGISTRY.find(part)
    if seed is not None and not callable(found):
        raise ValueError(f"robot {robot!r} has a seed, and {part!r} is one robot, not a family")
    if callable(found):
        found = _REGISTRY.call(robot, found, *([] if seed is None else [seed]))
    if not isinstance(found, Robot):
        raise ValueError(f"robot {robot!r} must be a Robot or a function that returns one, got {type(found).__name__}")
    return _with_limits(found, options)


@lru_cache(maxsize=16)
def _read(path: Path, options: RobotOptions, modified: int) -> Robot:
    """``modified`` is the time of the last change of the file."""
    from rover_rl.robots.robot import Robot

    return Robot.from_urdf(path, options=options)


def _with_limits(robot: Robot, options: RobotOptions) -> Robot:
    """A robot of another name than a file with the options on its drive and lidar."""
    drive = {"max_linear_acceleration" if name == "max_acceleration" else name: name for name in options.given}
    drive = {field: name for field, name in drive.items() if name not in LIDAR_OPTIONS}
    for field, name in drive.items():
        if not hasattr(robot.drive, field) or name == "drive":
            kind = type(robot.drive).__name__
            raise ValueError(f"option {name} does not fit robot {robot.name!r}, whose drive is a {kind}")
    changes: dict[str, Any] = dict(options.lidar_settings)
    if drive:
        limits: dict[str, Any] = {field: options.given[name] for field, name in drive.items()}
        changes["drive"] = replace(robot.drive, **limits)
    if options.lidar is not None:
        try:
            x, y, z = map(float, options.lidar.split())
        except ValueError:
            raise ValueError(f'lidar of robot {robot.name!r} must be "x y z", got {options.lidar!r}') from None
        changes["lidar_position"] = x, y, z
    return replace(robot, **changes) if changes else robot


def get_robots(robots: RobotSource) -> tuple[Robot, ...]:
    """Returns the robots of a robot, its name, a range of seeds (``"any:0-255"``), or a list of them, each once.

    Raises:
        ValueError: as :func:`get_robot`, or if there are no robots or too many, or a range is not in order.
    """
    return tuple(dict.fromkeys(robot for entry in robots_by_entry(robots) for robot in entry))


def robots_by_entry(robots: RobotSource) -> list[list[Robot]]:
    """Returns the robots of each entry of a list, as :func:`get_robots` takes it: one, or those of a range."""
    from rover_rl.robots.fleet import MAX_ROBOTS

    entries = [robots] if isinstance(robots, str) or not isinstance(robots, Sequence) else robots
    parts = [Name.parse(entry) if isinstance(entry, str) else [entry] for entry in entries]
    count = sum(map(len, parts))
    if not 1 <= count <= MAX_ROBOTS:
        raise ValueError(f"robot must give 1 to {MAX_ROBOTS} robots, as 'any:0-255' does, got {count}")
    return [[get_robot(str(one) if isinstance(one, Name) else one) for one in part] for part in parts]


def check_training_robots(robots: RobotSource) -> None:
    """Raises a ``ValueError`` if robots are unknown, or one is for evaluation: has a seed of 10,000 or more."""
    for robot in get_robots(robots):
        family, _, seed = robot.name.rpartition(":")
        if family and seed.isdecimal() and int(seed) >= TRAINING_SEEDS:
            raise ValueError(
                f"robots with seeds from {TRAINING_SEEDS} up are for evaluation; train with lower ones, as in "
                f"'{family}:0-255', got {robot.name!r}"
            )


def __getattr__(name: str) -> Any:
    if name != "Robot":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from rover_rl.robots.robot import Robot

    return Robot


__all__ = ["FAMILIES", "ROBOTS", "Robot", "RobotOptions", "check_training_robots", "get_robot", "get_robots"]
__all__ += ["names_several", "register_robot", "robot_names"]
