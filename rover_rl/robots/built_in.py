"""The robots of the package. Masses, wheels, shapes and mounts are in their URDF files, with their sources."""

from __future__ import annotations

import math
from pathlib import Path

from rover_rl.robots.drives import Ackermann, SkidSteer
from rover_rl.robots.robot import Robot

_HERE = Path(__file__).parent
_SIDES: dict = {"left": ("front_left_wheel", "rear_left_wheel"), "right": ("front_right_wheel", "rear_right_wheel")}
_CAR: dict = {
    "knuckles": ("front_left_knuckle", "front_right_knuckle"),
    "front": ("front_left_wheel", "front_right_wheel"),
    "rear": ("rear_left_wheel", "rear_right_wheel"),
}

ROVER_ZERO = Robot.from_urdf(
    _HERE / "rover_zero.urdf",
    drive=SkidSteer(
        **_SIDES,
        separation=0.24,
        # Exceeds the torque that a wheel transfers to the ground (30 N x 0.122 m), so traction is the limit.
        torque=5.0,
        max_linear_acceleration=5.0,
        max_angular_acceleration=4.0,
    ),
    # The contract's.
    collision_range=0.3,
)
"""Rover Zero: its masses, wheels and mounts are in ``rover_zero.urdf``, and the limits of its drive are those of the
original's differential-drive plugin."""

LEO = Robot.from_urdf(
    _HERE / "leo.urdf",
    drive=SkidSteer(
        **_SIDES,
        separation=1.76 * 0.358,
        torque=2.0,
        max_linear_acceleration=2.5,
        max_angular_acceleration=3.0,
        # 6 rad/s at the wheels, straight ahead and on the spot.
        max_speed=0.375,
        max_yaw_rate=1.19,
    ),
    lidar_range=10.0,
)
"""Leo Rover: its torque, wheel speed and accelerations are those of its public URDF. The factor of the track is that of
its firmware; friction of the tires as Coulomb has it gives 1.72."""

JACKAL = Robot.from_urdf(
    _HERE / "jackal.urdf",
    drive=SkidSteer(
        **_SIDES,
        separation=1.5 * 0.37559,
        # Exceeds the torque that a wheel transfers to the ground (23 N x 0.098 m), so traction is the limit.
        torque=4.0,
        # Its controller allows 20 m/s^2 and 25 rad/s^2, more than its tires transfer (4.9 m/s^2).
        max_linear_acceleration=3.0,
        max_angular_acceleration=6.0,
        max_speed=2.0,
        max_yaw_rate=4.0,
    ),
    lidar_range=30.0,
    lidar_view=math.radians(270),
)
"""Jackal: speed and yaw rate are those of its public controller (``jackal_control/config/control.yaml``), and so is the
factor of the track; friction of the tires as Coulomb has it gives 1.46."""

HUSKY = Robot.from_urdf(
    _HERE / "husky.urdf",
    drive=SkidSteer(
        **_SIDES,
        separation=1.875 * 0.555,
        # Exceeds the torque that a wheel transfers to the ground (69 N x 0.165 m), so traction is the limit.
        torque=20.0,
        max_linear_acceleration=3.0,
        max_angular_acceleration=6.0,
        max_speed=1.0,
        max_yaw_rate=2.0,
    ),
    lidar_range=20.0,
    lidar_view=math.radians(270),
)
"""Husky: yaw rate and accelerations are those of its public controller (``husky_control/config/control.yaml``), and so
are track and factor of the track, 1.04 m together; friction of the tires as Coulomb has it gives the same."""

RACER = Robot.from_urdf(
    _HERE / "racer.urdf",
    drive=Ackermann(
        **_CAR,
        max_steering=0.4189,
        max_steering_rate=3.2,
        # Exceeds the torque that a rear wheel transfers to the ground (5 N x 0.051 m), so traction is the limit.
        torque=1.0,
        # f1tenth_gym has 9.51 m/s^2 on a track of friction 1.05. On ground of 0.5, rear wheels slide from 2.1 m/s^2 on.
        max_linear_acceleration=2.0,
        max_speed=5.0,
    ),
    lidar_range=30.0,
    lidar_view=4.7,
)
"""Racer: steering limits are those of ``f1tenth_gym``, the speed is the stock limit of its motor controller."""

HUNTER = Robot.from_urdf(
    _HERE / "hunter.urdf",
    drive=Ackermann(
        **_CAR,
        # At this angle of the middle, the inner wheel is at its limit of 0.69 rad.
        max_steering=0.542,
        max_steering_rate=0.69,
        torque=10.0,
        # The controller allows 2 m/s^2. On ground of friction 0.5, rear wheels slide from 1.9 m/s^2 on.
        max_linear_acceleration=1.5,
        max_speed=1.5,
        max_yaw_rate=3.0,
    ),
)
"""Hunter SE: steering limits and torque are those of its public URDF. The speed is ours: its controller allows 10 m/s,
and what the robot drives is not public."""
