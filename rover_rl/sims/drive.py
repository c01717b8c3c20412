"""The differential drive: from a twist command to wheel speeds, and back to wheel odometry. Batched torch."""

from __future__ import annotations

import torch
from torch import Tensor

from rover_rl.sims.robots import Robot


def ramp(current: Tensor, command: Tensor, robot: Robot, dt: float) -> Tensor:
    """The twist after ``dt`` seconds on the way from ``current`` to ``command`` within the acceleration limits.

    Args:
        current: twist that the drive asks for now, ``[N, 2]`` (m/s, rad/s).
        command: twist wanted, ``[N, 2]``.
        robot: gives the limits.
        dt: duration in seconds.
    """
    limits = current.new_tensor((robot.max_linear_acceleration * dt, robot.max_angular_acceleration * dt))
    return current + torch.clamp(command - current, -limits, limits)


def wheel_speeds(twist: Tensor, robot: Robot) -> Tensor:
    """Speeds of the left and right wheels in rad/s, ``[N, 2]``, that drive ``twist`` ``[N, 2]`` (m/s, rad/s) without slip."""
    half = robot.wheel_separation / 2
    spread = twist.new_tensor((-half, half))
    return (twist[:, :1] + twist[:, 1:] * spread) / robot.wheel_radius


def wheel_odometry(left: Tensor, right: Tensor, robot: Robot) -> tuple[Tensor, Tensor]:
    """What a differential drive reports from its wheels' speeds (rad/s): forward speed (m/s) and yaw rate (rad/s).

    ``v = r (wR + wL) / 2`` and ``w = r (wR - wL) / separation``: the wheels' motion, not the body's, which differs
    when they slip.
    """
    radius = robot.wheel_radius
    return radius * (right + left) / 2, radius * (right - left) / robot.wheel_separation
