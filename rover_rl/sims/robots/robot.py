"""Robot: the figures of a skid-steer rover that a simulator and the task need."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from rover_rl.sims.robots.consistency import check_consistency


@dataclass(frozen=True)
class Robot:
    """A differentially driven rover.

    Positions are in the base frame: its origin lies on the ground below the middle of the rover, x forward, y left,
    z up. Lengths in meters, angles in radians.

    Args:
        name: its name; a live simulator knows it by this.
        urdf: path of its description. The link that is on no other is the base. Every wheel is a continuous joint about
            +y, on the base or on a link fixed to it, and a cylinder or sphere around its hub. Every link has one
            collision shape at most.
        left_wheels, right_wheels: names of the wheel joints of each side.
        wheel_positions: hub of each wheel, left then right, ``(x, y, z)``.
        wheel_radius: radius that turns speed over ground into wheel speed, and the radius of the wheel's shape.
        wheel_width: width of a wheel.
        wheel_separation: distance between left and right that the drive's kinematics assume. Skid steering slips, so
            that it differs from the geometric track.
        wheel_torque: the most torque a wheel motor gives, N m.
        max_linear_acceleration: of the drive's command, m/s^2.
        max_angular_acceleration: of the drive's command, rad/s^2.
        lidar_position: where the lidar sits.
        lidar_range: distance beyond which it sees nothing, m.
        imu_position: where the IMU sits.
        radius: of the disc around the origin that has to be free for the rover to stand somewhere.
        max_speed: highest forward speed that a live robot is commanded, either way, m/s. Simulated robots take what the
            task commands.
        max_yaw_rate: the same for the yaw rate, rad/s.

    Raises:
        ValueError: for a length, limit or torque that is not positive, positions that are not finite, wheels that do
            not match their positions or are on the wrong side, or figures that contradict the URDF
            (:mod:`rover_rl.sims.robots.consistency`).
        FileNotFoundError: if there is no description at ``urdf``.
    """

    name: str
    urdf: Path
    left_wheels: tuple[str, ...]
    right_wheels: tuple[str, ...]
    wheel_positions: tuple[tuple[float, float, float], ...]
    wheel_radius: float
    wheel_width: float
    wheel_separation: float
    wheel_torque: float
    max_linear_acceleration: float
    max_angular_acceleration: float
    lidar_position: tuple[float, float, float]
    lidar_range: float
    imu_position: tuple[float, float, float]
    radius: float
    max_speed: float = 1.0
    max_yaw_rate: float = 7.0

    def __post_init__(self) -> None:
        for field in (
            "wheel_radius",
            "wheel_width",
            "wheel_separation",
            "wheel_torque",
            "max_linear_acceleration",
            "max_angular_acceleration",
            "lidar_range",
            "radius",
            "max_speed",
            "max_yaw_rate",
        ):
            value = getattr(self, field)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{field} of robot {self.name!r} must be a positive number, got {value}")
        self._check_positions()
        object.__setattr__(self, "urdf", Path(self.urdf))
        if not self.urdf.is_file():
            raise FileNotFoundError(f"no description of robot {self.name!r} at {self.urdf}")
        check_consistency(self)

    def _check_positions(self) -> None:
        names = (*self.left_wheels, *self.right_wheels)
        if len(self.wheel_positions) != len(names):
            raise ValueError(
                f"robot {self.name!r} names {len(self.left_wheels)} left and {len(self.right_wheels)} right wheels, "
                f"but gives {len(self.wheel_positions)} wheel positions"
            )
        if not (self.left_wheels and self.right_wheels) or len(set(names)) != len(names):
            raise ValueError(
                f"robot {self.name!r} must have at least one wheel on each side and name each wheel once, "
                f"got left_wheels={self.left_wheels} and right_wheels={self.right_wheels}"
            )
        positions = [("wheel_positions", position) for position in self.wheel_positions]
        positions += [("lidar_position", self.lidar_position), ("imu_position", self.imu_position)]
        for field, position in positions:
            if len(position) != 3 or not all(map(math.isfinite, position)):
                raise ValueError(
                    f"{field} of robot {self.name!r} must have finite coordinates (x, y, z) in meters, got {position}"
                )
        sides = [("left", 1)] * len(self.left_wheels) + [("right", -1)] * len(self.right_wheels)
        for name, position, (side, sign) in zip(names, self.wheel_positions, sides, strict=True):
            if not sign * position[1] > 0:
                raise ValueError(
                    f"robot {self.name!r} has {side} wheel {name!r} at y = {position[1]} m in wheel_positions; "
                    "left wheels must be at y > 0, right wheels at y < 0"
                )
