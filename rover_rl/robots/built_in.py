"""The robots of the package. Masses, wheels, shapes and mounts are in their URDF files, with their sources.

On ground of friction 0.5, the tires of a skid-steer robot transfer up to 4.9 m/s^2, and the rear wheels of the cars
slide from about 2 m/s^2 on. A torque that exceeds what a wheel transfers to the ground leaves traction as the limit.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from rover_rl.robots.any_robot import CAR, SIDES
from rover_rl.robots.drives import Ackermann, Drive, SkidSteer
from rover_rl.robots.robot import Robot


def _skid_steer(track: float, torque: float, linear: float, angular: float, speed: float, turn: float) -> SkidSteer:
    """Takes the effective track, m, the torque, N m, and the limits of accelerations and speeds."""
    limits: dict[str, Any] = {
        "max_linear_acceleration": linear,
        "max_angular_acceleration": angular,
        "max_speed": speed,
    }
    return SkidSteer(**SIDES, separation=track, torque=torque, max_yaw_rate=turn, **limits)


def _car(steering: float, rate: float, torque: float, linear: float, speed: float, turn: float) -> Ackermann:
    """Takes the limit of the steering angle, rad, and of its rate, the torque, N m, and further limits."""
    limits: dict[str, Any] = {"max_linear_acceleration": linear, "max_speed": speed, "max_yaw_rate": turn}
    return Ackermann(**CAR, max_steering=steering, max_steering_rate=rate, torque=torque, **limits)


_TABLE: dict[str, tuple[Drive, dict[str, Any]]] = {
    # Limits of the original's differential-drive plugin. The collision range is the contract's.
    "rover_zero": (_skid_steer(0.24, 5.0, 5.0, 4.0, 1.0, 7.0), {"collision_range": 0.3}),
    # Torque, wheel speed (6 rad/s, straight ahead and on the spot) and accelerations of its public URDF. The factor of
    # the track is that of its firmware; friction of the tires as Coulomb has it gives 1.72.
    "leo": (_skid_steer(1.76 * 0.358, 2.0, 2.5, 3.0, 0.375, 1.19), {"lidar_range": 10.0}),
    # Speeds and factor of the track of its public controller (jackal_control/config/control.yaml), which allows
    # 20 m/s^2 and 25 rad/s^2, more than its tires transfer. Coulomb's law gives a factor of 1.46.
    "jackal": (
        _skid_steer(1.5 * 0.37559, 4.0, 3.0, 6.0, 2.0, 4.0),
        {"lidar_range": 30.0, "lidar_view": math.radians(270)},
    ),
    # Yaw rate, accelerations, track and its factor of its public controller (husky_control/config/control.yaml).
    # Coulomb's law gives the same track.
    "husky": (
        _skid_steer(1.875 * 0.555, 20.0, 3.0, 6.0, 1.0, 2.0),
        {"lidar_range": 20.0, "lidar_view": math.radians(270)},
    ),
    # Steering limits of f1tenth_gym, which has 9.51 m/s^2 on a track of friction 1.05; stock speed limit of its motor
    # controller.
    "racer": (_car(0.4189, 3.2, 1.0, 2.0, 5.0, 7.0), {"lidar_range": 30.0, "lidar_view": 4.7}),
    # Torque and steering limits of the public URDF of Hunter SE: the inner wheel is at its limit of 0.69 rad. The
    # speed is ours: its controller allows 10 m/s and 2 m/s^2, and what the robot drives is not public.
    "hunter": (_car(0.542, 0.69, 10.0, 1.5, 1.5, 3.0), {}),
}

ROVER_ZERO, LEO, JACKAL, HUSKY, RACER, HUNTER = (
    Robot.from_urdf(Path(__file__).with_name(f"{name}.urdf"), drive=drive, **settings)
    for name, (drive, settings) in _TABLE.items()
)
