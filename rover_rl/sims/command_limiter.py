"""Limits of the commands of rovers, in simulation and on a live rover."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from rover_rl.robots import Robot


class CommandLimits(NamedTuple):
    """Limits of commands in both directions: m/s, rad/s, m/s^2 and rad/s^2."""

    speed: float
    yaw_rate: float
    acceleration: float
    yaw_acceleration: float

    @classmethod
    def of(cls, robot: Robot, settings: Any) -> CommandLimits:
        """Returns the limits for a robot: its own, except where ``settings``, with names as ``max_speed``, say more."""
        drive = robot.drive
        return cls(
            settings.max_speed or drive.max_speed,
            settings.max_yaw_rate or drive.max_yaw_rate,
            settings.max_acceleration or drive.max_linear_acceleration,
            settings.max_yaw_acceleration or drive.max_angular_acceleration,
        )


class CommandLimiter:
    """Limits the commands of a batch of rovers, and suppresses oscillation of the yaw rate.

    On a drive without lag, the yaw rate of the heading PID changes its sign in nearly every step. Two measures prevent
    that: the yaw rate changes only as fast as the robot's drive does in training, and a change of the turning direction
    requires a desired yaw rate of at least ``min_reversal`` (rad/s). With less, the rover stops turning.

    Example:
        >>> limits = torch.tensor([CommandLimits(speed=1.0, yaw_rate=2.0, acceleration=5.0, yaw_acceleration=4.0)])
        >>> limiter, dt = CommandLimiter(0.5), torch.tensor([[0.05]])
        >>> limiter(torch.tensor([[0.9, 0.0]]), torch.tensor([[1.5, -3.0]]), dt, limits)
        tensor([[ 1.0000, -0.2000]])
    """

    def __init__(self, min_reversal: float, rows: int = 1, device: torch.device | str | None = None) -> None:
        self._min_reversal = min_reversal
        # Turning direction: -1, 1, or 0 before the first turn.
        self._direction = torch.zeros(rows, 1, device=device)

    def reset(self, mask: Tensor | None = None) -> None:
        """Clears the turning direction in the rows of ``mask`` (bool ``[N, 1]``) at the start of an episode."""
        every = torch.ones_like(self._direction, dtype=torch.bool) if mask is None else mask
        self._direction = self._direction.masked_fill(every, 0.0)

    def __call__(
        self, last: Tensor, desired: Tensor, dt: Tensor, limits: Tensor, active: Tensor | None = None
    ) -> Tensor:
        """Returns the commands on the way from ``last`` to ``desired``, ``[N, A]``.

        Args:
            last, desired: forward speed (m/s), yaw rate (rad/s) and further speeds (m/s), ``[N, A]``.
            dt: time since the last command, ``[N, 1]``, s.
            limits: :class:`CommandLimits` of each row, or one for all, ``[N, 4]`` or ``[1, 4]``.
            active: rows that receive a command, bool ``[N, 1]``. ``None``: all.
        """
        speed, yaw_rate, acceleration, yaw_acceleration = limits.split(1, -1)
        further = desired.shape[-1] - 2
        most = torch.cat((speed, yaw_rate, *[speed] * further), -1)
        change = torch.cat((acceleration, yaw_acceleration, *[acceleration] * further), -1) * dt
        turn = desired[:, 1:2]
        reverses_little = (turn * self._direction < 0) & (turn.abs() < self._min_reversal)
        reached = torch.clamp(torch.clamp(desired, -most, most), last - change, last + change)
        stopped = torch.clamp(torch.zeros_like(turn), last[:, 1:2] - change[:, 1:2], last[:, 1:2] + change[:, 1:2])
        turn = torch.where(reverses_little, stopped, reached[:, 1:2])
        turns = turn != 0 if active is None else (turn != 0) & active
        self._direction = torch.where(turns, turn.sign().to(self._direction), self._direction)
        return torch.cat((reached[:, :1], turn, reached[:, 2:]), -1)
