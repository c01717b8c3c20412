"""Clearpath Jackal, a skid-steer rover."""

from __future__ import annotations

import math
from pathlib import Path

from rover_rl.robots.drives import SkidSteer
from rover_rl.robots.robot import Robot

JACKAL = Robot.from_urdf(
    Path(__file__).with_name("jackal.urdf"),
    drive=SkidSteer(
        left=("front_left_wheel", "rear_left_wheel"),
        right=("front_right_wheel", "rear_right_wheel"),
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
