"""The differential drive: from a twist command to wheel speeds, and back to wheel odometry. Batched torch."""

from __future__ import annotations

import torch
from torch import Tensor

from rover_rl.sims.robots import Robot


class DifferentialDrive:
    """Kinematics and acceleration limits of a robot's drive; holds no state.

    Args:
        robot: gives wheel radius, wheel separation and limits.
        dt: time between two commands, s.
        device: where commands are.
    """

    def __init__(self, robot: Robot, dt: float, device: torch.device | str | None = None) -> None:
        self._limit = dt * torch.tensor((robot.max_linear_acceleration, robot.max_angular_acceleration), device=device)
        half = robot.wheel_separation / 2
        self._left_right = torch.tensor((-half, half), device=device) / robot.wheel_radius
        self._inverse_radius = torch.tensor(1 / robot.wheel_radius, device=device)
        linear, angular = robot.wheel_radius / 2, robot.wheel_radius / robot.wheel_separation
        self._from_left = torch.tensor((linear, -angular), device=device)
        self._from_right = torch.tensor((linear, angular), device=device)

    def ramp(self, current: Tensor, command: Tensor) -> Tensor:
        """The twist (m/s, rad/s; ``[N, 2]``) ``dt`` after ``current``, on the way to ``command`` within the limits."""
        return current + torch.clamp(command - current, -self._limit, self._limit)

    def wheel_speeds(self, twist: Tensor) -> Tensor:
        """Speeds of the left and right wheels (rad/s, ``[N, 2]``) that drive ``twist`` without slip."""
        return torch.addcmul(twist[:, :1] * self._inverse_radius, twist[:, 1:], self._left_right)

    def odometry(self, wheel_speeds: Tensor) -> Tensor:
        """What a differential drive reports from its wheels' speeds ``[N, 2]``: forward speed and yaw rate, ``[N, 2]``.

        ``v = r (wR + wL) / 2`` (m/s) and ``w = r (wR - wL) / separation`` (rad/s): the wheels' motion, not the body's,
        which differs when they slip.
        """
        return torch.addcmul(wheel_speeds[:, :1] * self._from_left, wheel_speeds[:, 1:], self._from_right)
