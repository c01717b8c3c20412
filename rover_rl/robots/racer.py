"""F1TENTH / RoboRacer car, a tenth of the size of a racing car."""

from __future__ import annotations

from pathlib import Path

from rover_rl.robots.drives import Ackermann
from rover_rl.robots.robot import Robot

RACER = Robot.from_urdf(
    Path(__file__).with_name("racer.urdf"),
    drive=Ackermann(
        knuckles=("front_left_knuckle", "front_right_knuckle"),
        front=("front_left_wheel", "front_right_wheel"),
        rear=("rear_left_wheel", "rear_right_wheel"),
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
