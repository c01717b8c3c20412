"""Rover Zero 4WD, the skid-steer rover of RoboTerrain."""

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
    # Exceeds the torque that a wheel transfers to the ground (30 N x 0.122 m), so traction is the limit.
    wheel_torque=5.0,
    max_linear_acceleration=5.0,
    max_angular_acceleration=4.0,
    lidar_position=(0.174, 0.0, 0.321),
    lidar_range=12.0,
    imu_position=(0.0, 0.0, 0.221),
    radius=0.35,
)
"""Rover Zero with the parameters of the original robot description.

Masses and mounts are in ``rover_zero.urdf``, the limits of the drive are those of its differential-drive plugin.
"""
