"""How fast the body of a robot turns, relative to what its wheels report."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from rover_rl.robots.drives import SkidSteer
from rover_rl.robots.robot import Robot
from rover_rl.robots.skidding import effective_track

# Yaw rate of the body relative to that of the wheel odometry: Rover Zero turns at 0.40 to 0.43 of the commanded rate
# in Warp and at 0.39 to 0.47 in Bullet, up to 2 rad/s, as its wheels slip.
YAW_GAIN = 0.41
# Distance of the wheels in the kinematics of a skid-steer that turns as commanded, relative to that of its wheels: that
# of Rover Zero with this gain, 0.24 m / 0.41 / 0.36 m.
SLIP = 1.626


@lru_cache(maxsize=1024)
def yaw_gain(robot: Robot) -> float:
    """Returns the yaw rate of the body of a robot in a slow turn, relative to that of its wheel odometry.

    The weight is taken to be in the middle of the wheels. 1 for a robot whose wheels do not slip in turns.

    Example:
        >>> from rover_rl.robots import get_robot
        >>> round(yaw_gain(get_robot("rover_zero")), 2)
        0.4
    """
    drive, wheels = robot.drive, robot.wheels
    if not isinstance(drive, SkidSteer) or len(drive.left) + len(drive.right) == 2:
        return 1.0
    points = np.array(wheels.hubs)[: len(drive.left) + len(drive.right), :2]
    sides = [1] * len(drive.left) + [-1] * len(drive.right)
    return drive.track(wheels) / effective_track(points, sides, points.mean(0).tolist(), wheels.width)


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
