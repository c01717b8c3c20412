"""Steady motion of a skid-steer rover on level ground by Coulomb's law: a reference for the simulators."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from rover_rl.sims.robots import Robot


@dataclass(frozen=True)
class Motion:
    """Steady motion of the origin of the base frame: forward and leftward speed (m/s), and yaw rate (rad/s)."""

    forward: float
    sideways: float
    yaw: float


def steady_motion(robot: Robot, center: float, linear: float, angular: float) -> Motion:
    """Solves for the steady motion in which the friction forces and their moment balance (quasi-static).

    Inertial forces are neglected. The load of each axle follows from the position of the center of mass and is
    distributed uniformly over the width of the treads. The result does not depend on the friction coefficient, as all
    forces are proportional to it.

    Args:
        robot: robot with two axles.
        center: x coordinate of the center of mass in the base frame, m.
        linear: commanded forward speed, m/s.
        angular: commanded yaw rate, rad/s.

    Raises:
        ValueError: if the solver finds no balance.
    """
    hubs = np.array(robot.wheel_positions)
    front, rear = hubs[:, 0].max(), hubs[:, 0].min()
    share = (center - rear) / (front - rear)
    tread_offsets = np.linspace(-1, 1, 17)[1::2] * robot.wheel_width / 2
    points = np.array([(x, y + offset) for x, y, _ in hubs for offset in tread_offsets])
    loads = np.array([share if x > center else 1 - share for x, _, _ in hubs for _ in tread_offsets])
    half = robot.wheel_separation / 2
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
