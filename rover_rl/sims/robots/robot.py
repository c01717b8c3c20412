"""``Robot``: a body, a drive and sensors, for the simulators and the task."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from rover_rl.sims.drives.base import Drive, Wheels
from rover_rl.sims.robots.description import Description
from rover_rl.sims.robots.footprint import footprint
from rover_rl.sims.robots.plausibility import check_plausibility
from rover_rl.sims.robots.wheels import read_wheels

Mount: TypeAlias = str | tuple[float, float, float]
"""Place of a sensor: the name of a link of the URDF, or its position (x, y, z) in the base frame, m."""


@dataclass(frozen=True)
class Robot:
    """A rover: a body, a drive and sensors. Masses, inertias, wheels, shapes and colors are those of its URDF.

    Positions are in the base frame, whose origin lies on the ground below the center of the rover: x forward, y left,
    z up. Lengths are in meters, angles in radians.

    Args:
        name: name of the robot, by which a live simulator identifies it.
        urdf: path of the URDF file. The base is the link that is the child of no joint. Every wheel has a continuous
            joint about +y, on the base, on a link fixed to it or on the link of a steering joint, and one cylinder or
            sphere around its hub. Every link has at most one collision shape.
        drive: drive, which names the joints of the wheels: see :mod:`rover_rl.sims.drives`.
        lidar: place of the lidar: a link of the URDF, or a position.
        imu: place of the IMU.
        lidar_range: maximum range of the lidar, m.
        sensors: sensors besides the lidar, IMU, wheel odometry and pose that every rover has: each a
            :class:`~rover_rl.envs.sensors.base.Sensor`, a registered name or ``"module:attribute"``. They add entries
            to the observation.
        radius: radius of the disc around the origin that must be free of obstacles where the rover stands. ``None``:
            that of the disc around its wheels and body, rounded up to a centimeter.

    Attributes:
        wheels: geometry of the wheels.
        lidar_position: position of the lidar, m.
        imu_position: position of the IMU, m.

    Raises:
        ValueError: if a length is not positive, the drive or a mount contradicts the URDF, or the robot cannot drive
            (:mod:`rover_rl.sims.robots.plausibility`, which also warns of what is unusual).
        FileNotFoundError: if ``urdf`` does not exist.

    Example:
        >>> robot = get_robot("rover_zero")
        >>> robot.wheels.radius, robot.drive.turns_in_place
        (0.122, True)
    """

    name: str
    urdf: Path
    drive: Drive
    lidar: Mount = "lidar_link"
    imu: Mount = "imu_link"
    lidar_range: float = 12.0
    radius: float = None  # type: ignore[assignment]  # Set from the outline below.
    sensors: tuple[Any, ...] = ()
    wheels: Wheels = field(init=False, repr=False)
    lidar_position: tuple[float, float, float] = field(init=False, repr=False)
    imu_position: tuple[float, float, float] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name, value in (("lidar_range", self.lidar_range), ("radius", self.radius)):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} of robot {self.name!r} must be a positive number, got {value}")
        object.__setattr__(self, "urdf", Path(self.urdf))
        object.__setattr__(self, "sensors", tuple(self.sensors))
        if not self.urdf.is_file():
            raise FileNotFoundError(f"no description of robot {self.name!r} at {self.urdf}")
        try:
            description = Description(self.urdf)
            object.__setattr__(self, "wheels", read_wheels(description, self.drive))
            object.__setattr__(self, "lidar_position", _position(description, "lidar", self.lidar))
            object.__setattr__(self, "imu_position", _position(description, "imu", self.imu))
        except ValueError as error:
            raise ValueError(f"robot {self.name!r} cannot be driven with its URDF {self.urdf}: {error}") from error
        if self.radius is None:
            outline = footprint(self)
            object.__setattr__(self, "radius", math.ceil(100 * outline.corner - 1e-9) / 100)
        check_plausibility(self)

    @classmethod
    def from_urdf(cls, path: Path | str, *, drive: Drive, name: str | None = None, **settings: Any) -> Robot:
        """Creates a robot from its URDF and its drive.

        Args:
            path: path of the URDF file. Expand xacro first: ``xacro robot.urdf.xacro > robot.urdf``.
            drive: drive.
            name: name of the robot. ``None``: that of the URDF.
            settings: further arguments of :class:`Robot`.

        Raises:
            ValueError: as :class:`Robot`.
            FileNotFoundError: if the file does not exist.
        """
        return cls(name or _name(Path(path)), Path(path), drive, **settings)


def _name(path: Path) -> str:
    """Returns the name that a URDF states, or that of the file."""
    try:
        return Description(path).name or path.stem
    except (ValueError, OSError):
        # The robot reports what is wrong.
        return path.stem


def _position(description: Description, sensor: str, mount: Mount) -> tuple[float, float, float]:
    """Returns the position of a sensor in the base frame."""
    if isinstance(mount, str):
        if mount not in description.fixed:
            raise ValueError(
                f"{sensor} must be a position (x, y, z) in meters, or one of the links fixed to the base, "
                f"{sorted(description.fixed)}, got {mount!r}"
            )
        mount = tuple(description.fixed[mount].position.tolist())
    if len(mount) != 3 or not all(map(math.isfinite, mount)):
        raise ValueError(f"{sensor} must have finite coordinates (x, y, z) in meters, got {mount}")
    return mount
