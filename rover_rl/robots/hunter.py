"""AgileX Hunter SE, a car."""

from __future__ import annotations

from pathlib import Path

from rover_rl.robots.drives import Ackermann
from rover_rl.robots.robot import Robot

HUNTER = Robot.from_urdf(
    Path(__file__).with_name("hunter.urdf"),
    drive=Ackermann(
        knuckles=("front_left_knuckle", "front_right_knuckle"),
        front=("front_left_wheel", "front_right_wheel"),
        rear=("rear_left_wheel", "rear_right_wheel"),
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
