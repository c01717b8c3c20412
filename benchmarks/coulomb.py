"""How a skid-steer rover moves on level ground by Coulomb's law alone: what a simulator should come to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from rover_rl.sims.robots import Robot


@dataclass(frozen=True)
class Motion:
    """Steady motion of the base frame's origin: forward and to the left (m/s), and yaw rate (rad/s)."""

    forward: float
    sideways: float
    yaw: float


def steady_motion(robot: Robot, center: float, linear: float, angular: float) -> Motion:
    """The motion at which friction balances, so slow that nothing else acts.

    Treads press evenly along their width, and each axle as its distance from the centre of mass has it. The coefficient
    does not matter: all forces are in proportion to it.

    Args:
        robot: with two axles.
        center: how far ahead of the base frame's origin its centre of mass is, m.
        linear, angular: the command, m/s and rad/s.

    Raises:
        ValueError: if no balance is found.
    """
    hubs = np.array(robot.wheel_positions)
    front, rear = hubs[:, 0].max(), hubs[:, 0].min()
    share = (center - rear) / (front - rear)
    along = np.linspace(-1, 1, 17)[1::2] * robot.wheel_width / 2
    points = np.array([(x, y + offset) for x, y, _ in hubs for offset in along])
    loads = np.array([share if x > center else 1 - share for x, _, _ in hubs for _ in along])
    half = robot.wheel_separation / 2
    treads = np.where(points[:, 1] > 0, linear - angular * half, linear + angular * half)

    def unbalanced(motion: np.ndarray) -> list[float]:
        forward, sideways, yaw = motion
        slip = np.stack((forward - yaw * points[:, 1] - treads, sideways + yaw * points[:, 0]), -1)
        force = -loads[:, None] * slip / np.sqrt((slip**2).sum(-1, keepdims=True) + 1e-10)
        moment = (points[:, 0] * force[:, 1] - points[:, 1] * force[:, 0]).sum()
        return [*force.sum(0), 5 * moment]

    starts = ([linear, 0.0, share * angular] for share in (0.2, 0.4, 0.6))
    found = min(
        (least_squares(unbalanced, start, xtol=1e-14, ftol=1e-14) for start in starts), key=lambda one: one.cost
    )
    if found.cost > 1e-6:
        raise ValueError(f"friction does not balance for the command ({linear}, {angular})")
    return Motion(*found.x)
