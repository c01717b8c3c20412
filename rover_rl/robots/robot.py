"""``Robot``: a body, a drive and sensors, for the simulators and the task."""

from __future__ import annotations

import math
import sys
import warnings
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rover_rl.robots.drives import Drive, Wheels
from rover_rl.robots.options import RobotOptions
from rover_rl.robots.shapes import HERE, Box, Frame, Mass, Shape, Vector, combined_mass

TOLERANCE = 0.01
"""Tolerance of positions and lengths in the checks of a robot, m."""
WEAKEST, WEAK = 2.0, 15.0
"""Slopes that the motors must be able to climb, and usually can, degrees."""
FULL_VIEW = math.radians(340)
"""Angle that a lidar sees from which on it sees what is behind the robot, rad."""


class Footprint(NamedTuple):
    """Rectangle around the wheels and the body of a robot, seen from above: lowest and highest x and y, m."""

    back: float
    front: float
    right: float
    left: float

    @property
    def half_length(self) -> float:
        """Largest distance from the origin along x, m."""
        return max(-self.back, self.front)

    @property
    def half_width(self) -> float:
        """Largest distance from the origin along y, m."""
        return max(-self.right, self.left)

    @property
    def corner(self) -> float:
        """Radius of a disc around the origin that holds the rectangle, m."""
        return math.hypot(self.half_length, self.half_width)


@dataclass(frozen=True, kw_only=True)
class Robot:
    """A rover: a rigid body of boxes, wheels that are alike, a drive and sensors.

    Positions are in the base frame, whose origin lies on the ground below the center of the rover: x forward, y left,
    z up. Lengths are in meters, angles in radians.

    Raises:
        ValueError: if a length is not positive, the drive cannot move the wheels, or the robot cannot drive: ``radius``
            is less than the reach of the body forward or sideways, the lidar is below the ground or outside of both the
            body and the disc, or the motors cannot climb a slope of 2 degrees.

    Warns:
        UserWarning: if a corner of the body is outside of the disc, the lidar is outside of the body, or the motors
            cannot climb a slope of 15 degrees.

    Example:
        >>> robot = get_robot("rover_zero")
        >>> robot.wheels.radius, robot.drive.turns_in_place
        (0.122, True)
    """

    name: str
    """Name of the robot, by which a live simulator identifies it."""
    drive: Drive
    """Drive, which names the joints of the wheels."""
    body: Mass
    """Mass of the body without wheels, knuckles and boxes with a mass of their own."""
    boxes: tuple[Box, ...]
    """Collision shape of the body."""
    wheels: Wheels
    wheel: Mass
    """Mass of each wheel, about its hub."""
    knuckle: Mass | None = None
    """Mass of each steering joint, about the hub of its wheel."""
    steering_limits: tuple[float, float] | None = None
    """Lowest and highest angle at which Bullet stops the steering joints, rad. ``None``: it does not."""
    lidar_position: Vector
    imu_position: Vector
    lidar_range: float = 12.0
    """Maximum range of the lidar, m."""
    lidar_view: float = 2 * math.pi
    """Angle that the lidar sees, centered on straight ahead; a full turn at most. Beams outside of it have no return,
    which a map does not take for free."""
    radius: float = None  # type: ignore[assignment]  # Set from the outline below.
    """Radius of the disc around the origin that must be free of obstacles where the rover stands. ``None``: that around
    its wheels and body, rounded up to a centimeter."""
    sensors: tuple[Any, ...] = ()
    """Sensors besides those that every rover has, which add entries to the observation: each a
    :class:`~rover_rl.envs.sensors.base.Sensor`, a registered name or ``"module:attribute"``."""
    # A rule of the task: robots that differ in it alone are the same.
    collision_range: float | None = field(default=None, compare=False)
    """Lidar reading below which the robot is in collision, m. ``None``: in each direction, the distance of its outline
    from the lidar and a margin: see :func:`~rover_rl.robots.footprint.collision_ranges`."""
    visuals: tuple[Shape, ...] = field(default=(), repr=False, compare=False)
    """Shapes for pictures, in the base frame, with all joints at zero."""
    order: tuple[str, ...] = field(default=(), repr=False, compare=False)
    """Wheel joints in the order in which Bullet solves their contacts. Empty: that of the drive."""
    urdf: Path | None = field(default=None, repr=False, compare=False)
    """File that the robot was read from."""
    notes: tuple[str, ...] = field(default=(), repr=False, compare=False)
    """What was assumed when the file was read, a sentence each."""

    def __post_init__(self) -> None:
        for name in ("lidar_range", "radius", "collision_range"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ValueError(f"{name} of robot {self.name!r} must be a positive number, got {value}")
        if not 0 < self.lidar_view <= 2 * math.pi:
            allowed = f"positive and at most 2 pi rad, got {self.lidar_view}"
            raise ValueError(f"lidar_view of robot {self.name!r} must be {allowed}")
        for name in ("lidar_position", "imu_position"):
            place = getattr(self, name)
            if len(place) != 3 or not all(map(math.isfinite, place)):
                raise ValueError(f"{name} must have finite coordinates (x, y, z) in meters, got {place}")
        object.__setattr__(self, "sensors", tuple(self.sensors))
        if len(self.wheels.hubs) != len(self.drive.wheels):
            named = f"names the wheels {self.drive.wheels}, it has {len(self.wheels.hubs)}"
            raise ValueError(f"the drive of robot {self.name!r} {named}")
        self.drive.check(self.wheels)
        if self.radius is None:
            object.__setattr__(self, "radius", math.ceil(100 * self.footprint.corner - 1e-9) / 100)
        _check_radius(self)
        _check_lidar(self)
        _check_motors(self)

    @property
    def sees_behind(self) -> bool:
        """Whether the lidar sees a full turn, or nearly so."""
        return self.lidar_view > FULL_VIEW

    @property
    def mass(self) -> float:
        """Mass of all parts, kg."""
        return math.fsum([*(each.mass for each, _ in self._parts()), *[self.wheel.mass] * len(self.wheels.hubs)])

    @cached_property
    def chassis(self) -> Mass:
        """Mass of all but the wheels, which is rigid."""
        return combined_mass(self._parts())

    def _parts(self) -> list[tuple[Mass, Frame]]:
        """Masses of all but the wheels, and their frames."""
        parts = [(mass, HERE) for mass in (self.body, *(box.mass for box in self.boxes)) if mass is not None]
        if self.knuckle is not None:
            hubs = zip(self.wheels.hubs, self.wheels.steering, strict=True)
            parts += [(self.knuckle, Frame(np.array(hub), np.eye(3))) for hub, joint in hubs if joint >= 0]
        return parts

    @cached_property
    def center_of_mass(self) -> Vector:
        """Center of mass, m."""
        chassis, hubs = self.chassis, np.array(self.wheels.hubs)
        moment = chassis.mass * np.array(chassis.center) + self.wheel.mass * hubs.sum(0)
        return tuple((moment / (chassis.mass + self.wheel.mass * len(hubs))).tolist())

    @cached_property
    def footprint(self) -> Footprint:
        """The smallest rectangle around the wheels and the boxes, seen from above."""
        reach = np.array((self.wheels.radius, self.wheels.width / 2 or self.wheels.radius))
        hubs = np.array(self.wheels.hubs)[:, :2]
        centers, sizes = (np.array([box[part] for box in self.boxes]).reshape(-1, 3)[:, :2] for part in (0, 1))
        back, right = np.concatenate((hubs - reach, centers - sizes / 2)).min(0).tolist()
        front, left = np.concatenate((hubs + reach, centers + sizes / 2)).max(0).tolist()
        return Footprint(back, front, right, left)

    @classmethod
    def from_urdf(
        cls,
        path: Path | str,
        *,
        drive: Drive | None = None,
        options: RobotOptions | None = None,
        name: str | None = None,
        lidar: str | Vector | None = None,
        imu: str | Vector | None = None,
        **settings: Any,
    ) -> Robot:
        """Creates a robot from the URDF of a wheeled robot.

        With a drive, its joints are those of the wheels, and the base frame is that of the file. Without, the wheels
        are found by their joints and shapes, and the drive by the wheels; casters become wheels without friction. All
        joints but those of the drive are held, the body becomes boxes, and the mass stays.

        Args:
            path: path of the URDF file. Expand xacro first: ``xacro robot.urdf.xacro > robot.urdf``.
            drive: drive. ``None`` finds it.
            options: what the URDF does not tell, if the drive is to be found.
            name: name of the robot. ``None``: that of the URDF.
            lidar, imu: places of the sensors: links of the URDF, or positions (x, y, z) in the base frame, m. ``None``:
                ``"lidar_link"`` and ``"imu_link"``; without a drive, links of such names, or in the middle.
            settings: further fields of :class:`Robot`.

        Raises:
            ValueError: as :class:`Robot`, or if no drive fits the wheels, or there are none.
            TypeError: if there are a drive and options.
            FileNotFoundError: if the file does not exist.

        Warns:
            UserWarning: of what was assumed or left out.
        """
        from rover_rl.robots.urdf.read import read_urdf

        if drive is not None and options is not None:
            raise TypeError("from_urdf takes a drive or options to find it, not both")
        read = read_urdf(Path(path), drive, options, name, lidar, imu)
        if read["notes"]:
            sentence = f"{Path(path).name}: robot {read['name']!r} is {'; '.join(read['notes'])}"
            warnings.warn(sentence, stacklevel=_level_of_user())
        return cls(**{**read, **(options.lidar_settings if options else {}), **settings})


def _level_of_user() -> int:
    """Stack level, for a warning of the caller, of the first code that is no installed package."""
    frame, level = sys._getframe(1), 1
    package = str(Path(__file__).parents[1])
    while frame.f_back is not None and any(part in frame.f_code.co_filename for part in (package, "site-packages")):
        frame, level = frame.f_back, level + 1
    return level


def _check_radius(robot: Robot) -> None:
    outline, radius = robot.footprint, f"radius of robot {robot.name!r} is {robot.radius:g} m, and its"
    reach = max(outline.half_length, outline.half_width)
    if robot.radius < reach - TOLERANCE:
        raise ValueError(
            f"{radius} body and wheels reach {reach:.3g} m from the origin: it would start in obstacles; "
            f"{outline.corner:.3g} m holds all of it"
        )
    if robot.radius < outline.corner - TOLERANCE:
        sentence = f"{radius} corners are {outline.corner:.3g} m from the origin: they may start in obstacles"
        warnings.warn(sentence, stacklevel=4)


def _check_lidar(robot: Robot) -> None:
    outline, (x, y, z) = robot.footprint, robot.lidar_position
    if not z > 0:
        raise ValueError(f"the lidar of robot {robot.name!r} is at z = {z:g} m; it must be above the ground, at z > 0")
    beside = max(outline.back - x, x - outline.front, outline.right - y, y - outline.left)
    place = f"the lidar of robot {robot.name!r} is at x = {x:g}, y = {y:g} m, {beside:.3g} m outside of its body"
    if beside > TOLERANCE and math.hypot(x, y) > robot.radius + TOLERANCE:
        raise ValueError(f"{place} and outside of its radius of {robot.radius:g} m: it would start in obstacles")
    if beside > TOLERANCE:
        warnings.warn(f"{place}: check lidar_position", stacklevel=4)


def _check_motors(robot: Robot) -> None:
    driven, torque, radius = sum(map(len, robot.drive.motors)), robot.drive.torque, robot.wheels.radius
    force = driven * torque / radius
    slope = math.degrees(math.asin(min(1.0, force / (robot.mass * 9.81))))
    problem = (
        f"the motors of robot {robot.name!r} push with {force:.3g} N ({driven} x {torque:g} N m on a radius of "
        f"{radius:g} m), and it has {robot.mass:.3g} kg: it cannot climb a slope of"
    )
    if slope < WEAKEST:
        raise ValueError(f"{problem} {WEAKEST:g} degrees; raise the torque of its drive")
    if slope < WEAK:
        warnings.warn(f"{problem} more than {slope:.0f} degrees", stacklevel=4)
