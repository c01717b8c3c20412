"""``Robot``: a body, a drive and sensors, for the simulators and the task."""

from __future__ import annotations

import math
import sys
import warnings
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from rover_rl.robots.description import Description
from rover_rl.robots.drives import Drive, Wheels
from rover_rl.robots.footprint import footprint
from rover_rl.robots.options import RobotOptions
from rover_rl.robots.wheels import read_wheels

Mount: TypeAlias = str | tuple[float, float, float]
"""Place of a sensor: the name of a link of the URDF, or its position (x, y, z) in the base frame, m."""

TOLERANCE = 0.01
"""Tolerance of positions and lengths in :func:`check_plausibility`, m."""
WEAKEST, WEAK = 2.0, 15.0
"""Slopes that the motors must be able to climb, and usually can, degrees."""
_GRAVITY = 9.81


FULL_VIEW = math.radians(340)
"""Angle that a lidar sees from which on it sees what is behind the robot, rad."""


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
        drive: drive, which names the joints of the wheels: see :mod:`rover_rl.robots.drives`.
        lidar: place of the lidar: a link of the URDF, or a position.
        imu: place of the IMU.
        lidar_range: maximum range of the lidar, m.
        lidar_view: angle that the lidar sees, centered on straight ahead; a full turn at most. Beams outside of it
            have no return. A map of what has been seen does not take them for free.
        sensors: sensors besides the lidar, IMU, wheel odometry and pose that every rover has: each a
            :class:`~rover_rl.envs.sensors.base.Sensor`, a registered name or ``"module:attribute"``. They add entries
            to the observation.
        radius: radius of the disc around the origin that must be free of obstacles where the rover stands. ``None``:
            that of the disc around its wheels and body, rounded up to a centimeter.
        collision_range: lidar reading below which the robot is in collision, m. ``None``: in each direction, the
            distance of its outline from the lidar and a margin: see
            :func:`~rover_rl.robots.footprint.collision_ranges`.

    Attributes:
        mass: mass of all links, kg.
        wheels: geometry of the wheels.
        lidar_position: position of the lidar, m.
        imu_position: position of the IMU, m.

    Raises:
        ValueError: if a length is not positive, the drive or a mount contradicts the URDF, or the robot cannot drive
            (:func:`check_plausibility`, which also warns of what is unusual).
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
    lidar_view: float = 2 * math.pi
    radius: float = None  # type: ignore[assignment]  # Set from the outline below.
    sensors: tuple[Any, ...] = ()
    # A rule of the task: robots that differ in it alone are the same.
    collision_range: float | None = field(default=None, compare=False)
    mass: float = field(init=False, repr=False)
    wheels: Wheels = field(init=False, repr=False)
    lidar_position: tuple[float, float, float] = field(init=False, repr=False)
    imu_position: tuple[float, float, float] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("lidar_range", "radius", "collision_range"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} of robot {self.name!r} must be a positive number, got {value}")
        if not 0 < self.lidar_view <= 2 * math.pi:
            raise ValueError(
                f"lidar_view of robot {self.name!r} must be positive and at most 2 pi rad, got {self.lidar_view}"
            )
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
        masses = (link.inertial.mass for link in description.links.values() if link.inertial is not None)
        object.__setattr__(self, "mass", math.fsum(masses))
        if self.radius is None:
            object.__setattr__(self, "radius", math.ceil(100 * footprint(self).corner - 1e-9) / 100)
        check_plausibility(self)

    @property
    def sees_behind(self) -> bool:
        """Whether the lidar sees a full turn, or nearly so: :data:`FULL_VIEW`."""
        return self.lidar_view > FULL_VIEW

    @classmethod
    def from_urdf(
        cls,
        path: Path | str,
        *,
        drive: Drive | None = None,
        name: str | None = None,
        options: RobotOptions | None = None,
        **settings: Any,
    ) -> Robot:
        """Creates a robot from its URDF.

        With a drive, the URDF is taken as it is, and must be as :class:`Robot` needs it. Without, it may be any URDF of
        a wheeled robot: the wheels are found by their joints and shapes, the drive by the wheels, and a URDF as
        :class:`Robot` needs it is derived, in the folder of the cache. All joints but those of the drive are held, the
        body becomes boxes, casters become wheels without friction, and the mass stays.

        Args:
            path: path of the URDF file. Expand xacro first: ``xacro robot.urdf.xacro > robot.urdf``.
            drive: drive. ``None`` finds it.
            name: name of the robot. ``None``: that of the URDF.
            options: what the URDF does not tell, if the drive is to be found.
            settings: further arguments of :class:`Robot`.

        Raises:
            ValueError: as :class:`Robot`, or if no drive fits the wheels, or there are none.
            TypeError: if there are a drive and options.
            FileNotFoundError: if the file does not exist.

        Warns:
            UserWarning: of what was assumed, if the drive was found.
        """
        path = Path(path)
        if drive is None:
            return cls._found_in(path, name, options or RobotOptions(), settings)
        if options is not None:
            raise TypeError("from_urdf takes a drive or options to find it, not both")
        # The robot reports what is wrong with the file.
        with suppress(ValueError, OSError):
            name = name or Description(path).name
        return cls(name or path.stem, path, drive, **settings)

    @classmethod
    def _found_in(cls, path: Path, name: str | None, options: RobotOptions, settings: dict[str, Any]) -> Robot:
        """Returns the robot that is found in any URDF of a wheeled robot."""
        # Reads meshes, for which the other robots need not wait.
        from rover_rl.robots.urdf import read_urdf

        read = read_urdf(path, options, name)
        sentence = f"{path.name}: robot {read.name!r} is read as {read.summary}: {'; '.join(read.notes)}"
        warnings.warn(sentence, stacklevel=_level_of_user())
        return cls(read.name, read.urdf, read.drive, **{**options.lidar_settings, **settings})


def _level_of_user() -> int:
    """Returns the stack level, for a warning of the caller, of the first code that is no installed package."""
    frame, level = sys._getframe(1), 1
    package = str(Path(__file__).parents[1])
    while frame.f_back is not None and any(part in frame.f_code.co_filename for part in (package, "site-packages")):
        frame, level = frame.f_back, level + 1
    return level


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


def check_plausibility(robot: Robot) -> None:
    """Checks that a robot fits into its disc, that its lidar is on it, and that its motors can move it.

    Raises:
        ValueError: if ``radius`` is less than the reach of the body forward or sideways, if the lidar is below the
            ground, or outside of both the body and the disc, or if the motors cannot climb a slope of 2 degrees.

    Warns:
        UserWarning: if a corner of the body is outside of the disc, if the lidar is outside of the body, or if the
            motors cannot climb a slope of 15 degrees.
    """
    _check_radius(robot)
    _check_lidar(robot)
    _check_motors(robot)


def _check_radius(robot: Robot) -> None:
    outline = footprint(robot)
    reach = max(outline.half_length, outline.half_width)
    if robot.radius < reach - TOLERANCE:
        raise ValueError(
            f"radius of robot {robot.name!r} is {robot.radius:g} m, and its body and wheels reach {reach:.3g} m from "
            f"the origin: it would start in obstacles; {outline.corner:.3g} m holds all of it"
        )
    if robot.radius < outline.corner - TOLERANCE:
        warnings.warn(
            f"radius of robot {robot.name!r} is {robot.radius:g} m, and its corners are {outline.corner:.3g} m from "
            "the origin: they may start in obstacles",
            stacklevel=5,
        )


def _check_lidar(robot: Robot) -> None:
    outline, (x, y, z) = footprint(robot), robot.lidar_position
    if not z > 0:
        raise ValueError(f"the lidar of robot {robot.name!r} is at z = {z:g} m; it must be above the ground, at z > 0")
    beside = max(outline.back - x, x - outline.front, outline.right - y, y - outline.left)
    if beside <= TOLERANCE:
        return
    place = f"the lidar of robot {robot.name!r} is at x = {x:g}, y = {y:g} m, {beside:.3g} m outside of its body"
    if math.hypot(x, y) > robot.radius + TOLERANCE:
        raise ValueError(f"{place} and outside of its radius of {robot.radius:g} m: it would start in obstacles")
    warnings.warn(f"{place}: check lidar", stacklevel=5)


def _check_motors(robot: Robot) -> None:
    driven = sum(map(len, robot.drive.motors))
    force = driven * robot.drive.torque / robot.wheels.radius
    slope = math.degrees(math.asin(min(1.0, force / (robot.mass * _GRAVITY))))
    if slope >= WEAK:
        return
    problem = (
        f"the motors of robot {robot.name!r} push with {force:.3g} N ({driven} x "
        f"{robot.drive.torque:g} N m on a radius of {robot.wheels.radius:g} m), and it has {robot.mass:.3g} kg"
    )
    if slope < WEAKEST:
        raise ValueError(f"{problem}: it cannot climb a slope of {WEAKEST:g} degrees; raise the torque of its drive")
    warnings.warn(f"{problem}: it cannot climb a slope of more than {slope:.0f} degrees", stacklevel=5)
