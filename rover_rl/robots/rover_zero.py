"""Rover Zero 4WD, the skid-steer rover of RoboTerrain."""

from __future__ import annotations

from pathlib import Path

from rover_rl.robots.drives import SkidSteer
from rover_rl.robots.robot import Robot

ROVER_ZERO = Robot.from_urdf(
    Path(__file__).with_name("rover_zero.urdf"),
    drive=SkidSteer(
        left=("front_left_wheel", "rear_left_wheel"),
        right=("front_right_wheel", "rear_right_wheel"),
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
