"""Motion of a skid-steer rover by Coulomb's law of friction: a reference for the simulators.

Every wheel that slips carries the friction force ``mu N`` against its slip, whatever its speed and direction. On a
plane of slope ``s``, the loads of all wheels add up to ``m g cos s``, so that the sum of the forces of wheels that slip
in the same direction does not depend on how the wheels share the load.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from rover_rl.robots import Robot

GRAVITY = 9.81  # gravitational acceleration of the simulators, m/s^2


class Motion(NamedTuple):
    """Motion of the origin of the base frame: forward and leftward speed (m/s), and yaw rate (rad/s)."""

    forward: float
    sideways: float
    yaw: float


def steady_motion(robot: Robot, center: float, linear: float, angular: float) -> Motion:
    """Steady motion of a robot with two axles, in which the friction forces and their moment balance (quasi-static).

    Its commands are ``linear`` (m/s) and ``angular`` (rad/s). Inertial forces are neglected. The load of each axle
    follows from the ``center`` of mass, x in the base frame (m), and is distributed uniformly over the width of the
    treads. The friction coefficient does not matter, as all forces are proportional to it.
    """
    hubs = np.array(robot.wheels.hubs)
    front, rear = hubs[:, 0].max(), hubs[:, 0].min()
    share = (center - rear) / (front - rear)
    tread_offsets = np.linspace(-1, 1, 17)[1::2] * robot.wheels.width / 2
    points = np.array([(x, y + offset) for x, y, _ in hubs for offset in tread_offsets])
    loads = np.array([share if x > center else 1 - share for x, _, _ in hubs for _ in tread_offsets])
    half = robot.drive.separation / 2
    treads = np.where(points[:, 1] > 0, linear - angular * half, linear + angular * half)

    def residual(motion: np.ndarray) -> list[float]:
        forward, sideways, yaw = motion
        slip = np.stack((forward - yaw * points[:, 1] - treads, sideways + yaw * points[:, 0]), -1)
        force = -loads[:, None] * slip / np.sqrt((slip**2).sum(-1, keepdims=True) + 1e-10)
        moment = (points[:, 0] * force[:, 1] - points[:, 1] * force[:, 0]).sum()
        return [*force.sum(0), 5 * moment]

    starts = ([linear, 0.0, share * angular] for share in (0.2, 0.4, 0.6))
    solution = min(
        (least_squares(residual, start, xtol=1e-14, ftol=1e-14) for start in starts), key=lambda result: result.cost
    )
    if solution.cost > 1e-6:
        raise ValueError(f"friction does not balance for the command ({linear}, {angular})")
    return Motion(*solution.x)


def friction_angle(friction: float) -> float:
    """The steepest slope that a rover stands on, in any direction, and that it climbs, degrees.

    All wheels can slip at once. Gravity pulls along the slope with ``m g sin s``, and friction holds or drives with at
    most ``mu m g cos s``: they balance at ``tan s = mu``. On a side slope too: wheels that roll without slip in their
    own direction carry no force there, which leaves all of ``mu N`` against sideways slip.
    """
    return math.degrees(math.atan(friction))


def climbing_acceleration(friction: float, slope: float) -> float:
    """Acceleration up a slope (degrees) while all wheels spin, ``g (mu cos s - sin s)``, m/s^2.

    Friction drives each wheel uphill with ``mu N`` for as long as its tread moves faster than the ground. Negative on
    slopes steeper than :func:`friction_angle`: the rover slides down although its wheels spin.
    """
    angle = math.radians(slope)
    return GRAVITY * (friction * math.cos(angle) - math.sin(angle))


def sliding_acceleration(friction: float, slope: float) -> float:
    """Acceleration down a slope (degrees) with locked wheels, ``g (sin s - mu cos s)``, m/s^2, at least 0.

    The direction in which the rover faces does not matter: locked wheels slip straight down the slope, and the friction
    forces, in proportion to the loads, have no moment about the center of mass.
    """
    angle = math.radians(slope)
    return max(0.0, GRAVITY * (math.sin(angle) - friction * math.cos(angle)))


def climbing_time(friction: float, slope: float, speed: float) -> float:
    """Time from standing to ``speed`` (m/s) up a slope (degrees) with spinning wheels, s; infinite if too steep."""
    acceleration = climbing_acceleration(friction, slope)
    return speed / acceleration if acceleration > 0 else math.inf


def braking_distance(friction: float, speed: float) -> float:
    """Distance in which wheels that lock at a speed (m/s) stop a rover on level ground, ``v^2 / (2 mu g)``, m.

    A simulator that updates the velocity before the position (semi-implicit Euler) stops ``v dt / 2`` earlier: from
    1 m/s with steps of 10 ms by 5 mm.
    """
    return speed**2 / (2 * friction * GRAVITY)


def front_load(robot: Robot, center: tuple[float, float], friction: float) -> float:
    """Share of the load on the front wheels of a two-axle rover whose wheels all slip along its length.

    The ground's force of direction ``(mu, 1)``, forward and up, passes through the ``center`` of mass (x and z in the
    base frame, m), since the rover does not rotate. It meets the ground ``mu h`` behind the center of mass, at the
    height ``h`` above the ground, and the loads balance about this point. ``friction`` is negative if it brakes. The
    formulas above hold for shares between 0 and 1: while every wheel is loaded.
    """
    hubs = np.array(robot.wheels.hubs)
    front, rear = hubs[:, 0].max(), hubs[:, 0].min()
    height = center[1] - (hubs[0, 2] - robot.wheels.radius)
    return float((center[0] - friction * height - rear) / (front - rear))
