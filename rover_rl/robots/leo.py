"""Leo Rover, a small skid-steer rover."""

from __future__ import annotations

from pathlib import Path

from rover_rl.robots.drives import SkidSteer
from rover_rl.robots.robot import Robot

LEO = Robot.from_urdf(
    Path(__file__).with_name("leo.urdf"),
    drive=SkidSteer(
        left=("front_left_wheel", "rear_left_wheel"),
        right=("front_right_wheel", "rear_right_wheel"),
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
