"""Plausibility check of a robot: refuses what cannot drive, and warns of what is unusual."""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING

from rover_rl.sims.robots.description import Description
from rover_rl.sims.robots.footprint import Footprint, footprint

if TYPE_CHECKING:
    from rover_rl.sims.robots.robot import Robot

TOLERANCE = 0.01
"""Tolerance of positions and lengths, m."""
WEAKEST, WEAK = 2.0, 15.0
"""Slopes that the motors must be able to climb, and usually can, degrees."""
_GRAVITY = 9.81


def check_plausibility(robot: Robot) -> None:
    """Checks that a robot fits into its disc, that its lidar is on it, and that its motors can move it.

    Raises:
        ValueError: if ``radius`` is less than the reach of the body forward or sideways, if the lidar is below the
            ground, or outside of both the body and the disc, or if the motors cannot climb a slope of 2 degrees.

    Warns:
        UserWarning: if a corner of the body is outside of the disc, if the lidar is outside of the body, or if the
            motors cannot climb a slope of 15 degrees.
    """
    outline = footprint(robot)
    _check_radius(robot, outline)
    _check_lidar(robot, outline)
    _check_motors(robot)


def _check_radius(robot: Robot, outline: Footprint) -> None:
    reach = max(outline.half_length, outline.half_width)
    if robot.radius < reach - TOLERANCE:
        raise ValueError(
            f"radius of robot {robot.name!r} is {robot.radius:g} m, and its body and wheels reach {reach:.3g} m from "
            f"the origin: it would start in obstacles; {outline.corner:.3g} m holds all of it"
        )
    if robot.radius < outline.corner - TOLERANCE:
        warnings.warn(
            f"radius of robot {robot.name!r} is {robot.radius:g} m, and its corners are {outline.corner:.3g} m from "
            "the origin: they may start in obstacles",
            stacklevel=5,
        )


def _check_lidar(robot: Robot, outline: Footprint) -> None:
    x, y, z = robot.lidar_position
    if not z > 0:
        raise ValueError(f"the lidar of robot {robot.name!r} is at z = {z:g} m; it must be above the ground, at z > 0")
    beside = max(outline.back - x, x - outline.front, outline.right - y, y - outline.left)
    if beside <= TOLERANCE:
        return
    place = f"the lidar of robot {robot.name!r} is at x = {x:g}, y = {y:g} m, {beside:.3g} m outside of its body"
    if math.hypot(x, y) > robot.radius + TOLERANCE:
        raise ValueError(f"{place} and outside of its radius of {robot.radius:g} m: it would start in obstacles")
    warnings.warn(f"{place}: check lidar", stacklevel=5)


def _check_motors(robot: Robot) -> None:
    links = Description(robot.urdf).links.values()
    mass = sum(link.inertial.mass for link in links if link.inertial is not None)
    driven = sum(map(len, robot.drive.motors))
    force = driven * robot.drive.torque / robot.wheels.radius
    slope = math.degrees(math.asin(min(1.0, force / (mass * _GRAVITY))))
    if slope >= WEAK:
        return
    problem = (
        f"the motors of robot {robot.name!r} push with {force:.3g} N ({driven} x "
        f"{robot.drive.torque:g} N m on a radius of {robot.wheels.radius:g} m), and it has {mass:.3g} kg"
    )
    if slope < WEAKEST:
        raise ValueError(f"{problem}: it cannot climb a slope of {WEAKEST:g} degrees; raise the torque of its drive")
    warnings.warn(f"{problem}: it cannot climb a slope of more than {slope:.0f} degrees", stacklevel=5)
