"""Robot: parameters of a skid-steer rover for the simulators and the task."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from rover_rl.sims.robots.consistency import check_consistency
from rover_rl.sims.robots.plausibility import check_plausibility


@dataclass(frozen=True)
class Robot:
    """Parameters of a rover with a differential drive.

    Positions are in the base frame, whose origin lies on the ground below the center of the rover: x forward, y left,
    z up. Lengths are in meters, angles in radians.

    Args:
        name: name of the robot, by which a live simulator identifies it.
        urdf: path of the URDF file. The base is the link that is the child of no joint. Every wheel has a continuous
            joint about +y, on the base or on a link fixed to it, and one cylinder or sphere around its hub. Every link
            has at most one collision shape.
        left_wheels: names of the joints of the left wheels.
        right_wheels: names of the joints of the right wheels.
        wheel_positions: hub ``(x, y, z)`` of each wheel, left then right.
        wheel_radius: radius of the wheels, also for the conversion between ground speed and wheel speed.
        wheel_width: width of a wheel.
        wheel_separation: effective distance between the left and right wheels in the kinematics of the drive. It
            differs from the geometric track because the wheels slip in turns.
        wheel_torque: maximum torque of a wheel motor, N m.
        max_linear_acceleration: maximum acceleration of the forward speed command, m/s^2.
        max_angular_acceleration: maximum acceleration of the yaw rate command, rad/s^2.
        lidar_position: position of the lidar.
        lidar_range: maximum range of the lidar, m.
        imu_position: position of the IMU.
        radius: radius of the disc around the origin that must be free of obstacles where the rover stands.
        max_speed: maximum absolute forward speed commanded to a real robot, m/s. Does not limit simulated robots.
        max_yaw_rate: maximum absolute yaw rate commanded to a real robot, rad/s. Does not limit simulated robots.

    Raises:
        ValueError: if a length, limit or torque is not positive, a position is not finite, the wheels do not match
            their positions or are on the wrong side, the parameters contradict the URDF
            (:mod:`rover_rl.sims.robots.consistency`), or the robot cannot drive
            (:mod:`rover_rl.sims.robots.plausibility`, which also warns of what is unusual).
        FileNotFoundError: if ``urdf`` does not exist.
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
        check_plausibility(self)

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
