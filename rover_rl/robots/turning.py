"""How fast the body of a robot turns, relative to what its wheels report."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from rover_rl.robots.drives import SkidSteer, effective_track
from rover_rl.robots.robot import Robot

# Yaw rate of the body relative to that of the wheel odometry: Rover Zero turns at 0.40 to 0.43 of the commanded rate
# in Warp and at 0.39 to 0.47 in Bullet, up to 2 rad/s, as its wheels slip.
YAW_GAIN = 0.41
# Effective track of a skid-steer relative to the distance of its wheels: Rover Zero's, 0.24 m / 0.41 / 0.36 m.
SLIP = 1.626


def _slipping(robot: Robot) -> SkidSteer | None:
    """The drive of a robot whose wheels slip in turns: a skid-steer with several wheels a side."""
    drive = robot.drive
    return drive if isinstance(drive, SkidSteer) and len(drive.left) + len(drive.right) > 2 else None


@lru_cache(maxsize=1024)
def yaw_gain(robot: Robot) -> float:
    """Returns the yaw rate of the body of a robot in a slow turn, relative to that of its wheel odometry.

    The weight is taken to be in the middle of the wheels. 1 for a robot whose wheels do not slip in turns.
    """
    drive, wheels = _slipping(robot), robot.wheels
    if drive is None:
        return 1.0
    sides = [1] * len(drive.left) + [-1] * len(drive.right)
    points = np.array(wheels.hubs)[: len(sides), :2]
    return drive.track(wheels) / effective_track(points, sides, points.mean(0).tolist(), wheels.width)


def estimated_yaw_gain(robot: Robot) -> float:
    """Returns :func:`yaw_gain` with the share of the track that Rover Zero loses, for all robots whose wheels slip."""
    drive = _slipping(robot)
    if drive is None:
        return 1.0
    return round(drive.track(robot.wheels) / (SLIP * replace(drive, separation=None).track(robot.wheels)), 2)


def turn_gain(robot: Robot) -> float:
    """Returns the heading offset for each radian to turn: 2 for Rover Zero, less for a robot that turns faster."""
    return 2 * YAW_GAIN / estimated_yaw_gain(robot)
