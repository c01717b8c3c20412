"""What a URDF does not tell of a robot: its drive, limits and mounts, as settings of its name."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

from rover_rl.names import Name
from rover_rl.plain import take_numbers

DriveKind = Literal["skid_steer", "differential", "ackermann", "mecanum"]
LIDAR_OPTIONS = ("lidar", "lidar_range", "lidar_view")
"""Options on the lidar. The others, but for ``missing``, are on the drive."""


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
        for name, value in self.given.items():
            if isinstance(value, (int, float)) and not 0 < value < math.inf:
                raise ValueError(f"{name} of a robot must be a positive number, got {value}")
        if self.drive is not None and self.drive not in get_args(DriveKind):
            raise ValueError(f"drive of a robot must be one of {[*get_args(DriveKind)]}, got {self.drive!r}")
        if self.missing not in ("error", "skip"):
            raise ValueError(f"missing of a robot must be error or skip, got {self.missing!r}")
        if self.lidar is not None and not (isinstance(self.lidar, str) and self.lidar.strip()):
            raise ValueError(f'lidar of a robot must be a link or "x y z", got {self.lidar!r}')

    @property
    def given(self) -> dict[str, Any]:
        """The options that are set."""
        return {each.name: value for each in fields(self) if (value := getattr(self, each.name)) != each.default}

    @property
    def lidar_settings(self) -> dict[str, float]:
        """Range and view of the lidar, if they are set: arguments of ``Robot``."""
        return {name: value for name, value in self.given.items() if name in LIDAR_OPTIONS[1:]}


def with_options(name: str, options: RobotOptions) -> str:
    """Returns the name of a robot with options, ``"scout.urdf(drive=skid_steer)"``. They replace those in ``name``."""
    return str(Name.parse(name).replace(**options.given))


def split_options(name: str) -> tuple[str, int | None, RobotOptions]:
    """Returns the part, the seed and the options of the name of a robot."""
    parsed = Name.parse(name)
    settings = dict(parsed.settings)
    seed = settings.pop("seed", None)
    known = [item.name for item in fields(RobotOptions)]
    if unknown := [setting for setting in settings if setting not in known]:
        raise ValueError(f"robot {parsed.part!r} has no option {unknown[0]!r}; use some of {known}")
    return parsed.part, seed, RobotOptions(**settings)
