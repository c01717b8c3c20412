"""Rover Zero 4WD, the skid-steer rover that RoboTerrain drives."""

from __future__ import annotations

from pathlib import Path

from rover_rl.sims.robots.robot import Robot

ROVER_ZERO = Robot(
    name="rover_zero",
    urdf=Path(__file__).with_name("rover_zero.urdf"),
    left_wheels=("front_left_wheel", "rear_left_wheel"),
    right_wheels=("front_right_wheel", "rear_right_wheel"),
    wheel_positions=((0.1415, 0.18, 0.125), (-0.145, 0.18, 0.125), (0.1415, -0.18, 0.125), (-0.145, -0.18, 0.125)),
    wheel_radius=0.122,
    wheel_width=0.09,
    wheel_separation=0.24,
    # More than a wheel can bring to the ground (30 N x 0.122 m), so that traction, not the motor, limits.
    wheel_torque=5.0,
    max_linear_acceleration=5.0,
    max_angular_acceleration=4.0,
    lidar_position=(0.174, 0.0, 0.321),
    lidar_range=12.0,
    imu_position=(0.0, 0.0, 0.221),
    radius=0.35,
)
"""Figures of the original's robot description: masses and mounts in ``rover_zero.urdf``, the drive's limits as its
differential-drive plugin sets them."""
