"""Clearpath Husky A200, a large skid-steer rover."""

from __future__ import annotations

import math
from pathlib import Path

from rover_rl.robots.drives import SkidSteer
from rover_rl.robots.robot import Robot

HUSKY = Robot.from_urdf(
    Path(__file__).with_name("husky.urdf"),
    drive=SkidSteer(
        left=("front_left_wheel", "rear_left_wheel"),
        right=("front_right_wheel", "rear_right_wheel"),
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
