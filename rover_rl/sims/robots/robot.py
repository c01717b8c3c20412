"""Robot: the figures of a skid-steer rover that a simulator and the task need."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Robot:
    """A differentially driven rover.

    Positions are in the base frame: its origin lies on the ground below the middle of the rover, x forward, y left,
    z up. Lengths in metres, angles in radians.

    Args:
        name: its name; a live simulator knows it by this.
        urdf: path of its description. Every wheel is a continuous joint about +y, and every link has one collision
            shape at most.
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
        ValueError: for a length, limit or torque that is not positive, or wheels that do not match their positions.
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
        if len(self.wheel_positions) != len(self.left_wheels) + len(self.right_wheels):
            raise ValueError(
                f"robot {self.name!r} names {len(self.left_wheels)} left and {len(self.right_wheels)} right wheels, "
                f"but gives {len(self.wheel_positions)} wheel positions"
            )
        object.__setattr__(self, "urdf", Path(self.urdf))
        if not self.urdf.is_file():
            raise FileNotFoundError(f"no description of robot {self.name!r} at {self.urdf}")
