"""Slip of wheels in turns: how fast the body of a robot turns, relative to what its wheels report."""

from __future__ import annotations

from dataclasses import replace

from rover_rl.robots import Robot
from rover_rl.robots.drives import SkidSteer

# Yaw rate of the body relative to that of the wheel odometry: Rover Zero turns at 0.40 to 0.43 of the commanded rate
# in Warp and at 0.39 to 0.47 in Bullet, up to 2 rad/s, as its wheels slip.
YAW_GAIN = 0.41
# Distance of the wheels in the kinematics of a skid-steer that turns as commanded, relative to that of its wheels: that
# of Rover Zero with this gain, 0.24 m / 0.41 / 0.36 m.
SLIP = 1.626


def estimated_yaw_gain(robot: Robot) -> float:
    """Returns the yaw rate of a robot's body relative to that of its wheel odometry, from the places of its wheels.

    The wheels of a skid-steer with several a side slip sideways in turns, as those of Rover Zero do: the same share of
    the distance between left and right wheels is taken to be lost.
    """
    drive = robot.drive
    if not isinstance(drive, SkidSteer) or len(drive.left) + len(drive.right) == 2:
        return 1.0
    separation = drive.track(robot.wheels)
    return round(separation / (SLIP * replace(drive, separation=None).track(robot.wheels)), 2)


def turn_gain(robot: Robot) -> float:
    """Returns the heading offset for each radian to turn: 2 for Rover Zero, less for a robot that turns faster."""
    return 2 * YAW_GAIN / estimated_yaw_gain(robot)
