"""What a URDF does not tell of a robot: its drive, limits and mounts, as options beside its name."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields
from typing import Literal, get_args

from rover_rl.plain import take_numbers

DriveKind = Literal["skid_steer", "differential", "ackermann", "mecanum"]
"""Kinds of drives that are found in a URDF."""

SUFFIXES = (".urdf", ".xacro", ".sdf", ".xml")
"""Endings of the files that are taken for a robot. Only a URDF can be read; the others are refused with advice."""

LIDAR_OPTIONS = ("lidar", "lidar_range", "lidar_view")
"""Options on the lidar. The others, but for ``missing``, are on the drive."""

_OPTION = re.compile(r",(\w+)=([^,]*)")
_NUMBERS = (
    "lidar_range",
    "lidar_view",
    "max_speed",
    "max_yaw_rate",
    "max_acceleration",
    "max_steering",
    "torque",
    "separation",
)


@dataclass(frozen=True)
class RobotOptions:
    """What the URDF of a robot does not tell. All options are unset by default.

    Raises:
        ValueError: if a number is not positive, or a choice is unknown.
    """

    drive: DriveKind | None = None
    """Drive: skid_steer, differential, ackermann or mecanum. Default: by the joints of the wheels."""
    lidar: str | None = None
    """Place of the lidar: a link of the URDF, or "x y z" in the robot's base frame, m. Default: a link named lidar,
    laser or scan, or the middle of the top."""
    lidar_range: float | None = None
    """Range of the lidar, m. Default: 12."""
    lidar_view: float | None = None
    """Angle that the lidar sees, centered on straight ahead, rad. Default: a full turn."""
    max_speed: float | None = None
    """Largest speed, m/s. Default: 1."""
    max_yaw_rate: float | None = None
    """Largest yaw rate, rad/s. Default: what the largest speed gives."""
    max_acceleration: float | None = None
    """Largest acceleration, m/s^2. Default: 5, or less if the robot would tip over."""
    max_steering: float | None = None
    """Largest steering angle of the middle of the front axle, rad. Default: by the limits of the steering joints."""
    torque: float | None = None
    """Largest torque at a wheel, N m. Default: more than the ground takes."""
    separation: float | None = None
    """Effective distance of the left and right wheels in turns, m. Default: that of Coulomb friction."""
    missing: Literal["error", "skip"] = "error"
    """What happens with mesh files of collision shapes that do not exist or cannot be read."""

    def __post_init__(self) -> None:
        take_numbers(self)
        for name in _NUMBERS:
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ValueError(f"{name} of a robot must be a positive number, got {value}")
        if self.drive is not None and self.drive not in get_args(DriveKind):
            raise ValueError(f"drive of a robot must be one of {[*get_args(DriveKind)]}, got {self.drive!r}")
        if self.missing not in ("error", "skip"):
            raise ValueError(f"missing of a robot must be error or skip, got {self.missing!r}")
        if self.lidar is not None and ("," in self.lidar or not self.lidar.strip()):
            raise ValueError(f'lidar of a robot must be a link or "x y z", got {self.lidar!r}')

    @property
    def given(self) -> dict[str, str]:
        """The options that are set, as text."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        changed = {name: value for name, value in values.items() if value != getattr(_UNSET, name)}
        return {n: f"{v!r}" if isinstance(v, float) else ":".join(str(v).split()) for n, v in changed.items()}

    @property
    def lidar_settings(self) -> dict[str, float]:
        """Range and view of the lidar, if they are set: arguments of ``Robot``."""
        return {name: getattr(self, name) for name in ("lidar_range", "lidar_view") if getattr(self, name) is not None}


_UNSET = RobotOptions()


def with_options(name: str, options: RobotOptions) -> str:
    """Returns the name of a robot with options, ``"scout.urdf,drive=skid_steer"``. They replace those in ``name``."""
    own, before = split_options(name)
    given = {**before.given, **options.given}
    return own + "".join(f",{option}={value}" for option, value in given.items())


def split_options(name: str) -> tuple[str, RobotOptions]:
    """Splits the name of a robot from its options: the inverse of :func:`with_options`.

    Raises:
        ValueError: if an option is unknown or has a value of another kind.
    """
    found = [*_OPTION.finditer(name)]
    start = found[0].start() if found else len(name)
    own, values = name[:start], {each[1]: each[2] for each in found}
    if "".join(each[0] for each in found) != name[start:]:
        raise ValueError(f"options of robot {own!r} must be written as ,name=value, got {name[start:]!r}")
    known = [item.name for item in fields(RobotOptions)]
    if unknown := [option for option in values if option not in known]:
        raise ValueError(f"robot {own!r} has no option {unknown[0]!r}; use some of {known}")
    options: dict[str, object] = {**values}
    for option in _NUMBERS:
        if option in values:
            try:
                options[option] = float(values[option])
            except ValueError:
                raise ValueError(f"{option} of robot {own!r} must be a number, got {values[option]!r}") from None
    if "lidar" in values:
        options["lidar"] = values["lidar"].replace(":", " ")
    return own, RobotOptions(**options)  # type: ignore[arg-type]


def is_robot_file(name: str) -> bool:
    """Returns whether the name of a robot, without options, is that of a file."""
    return name.lower().endswith(SUFFIXES)
