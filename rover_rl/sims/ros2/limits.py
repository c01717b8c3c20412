"""Limits of a live rover's commands: speed, yaw rate and their rates of change."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rover_rl.sims.robots import Robot

MIN_REVERSAL = 0.5
"""Smallest desired yaw rate that changes the turning direction, rad/s. The heading PID outputs it at a heading error of
14 degrees."""


@dataclass(frozen=True)
class CommandLimits:
    """Limits of the commands that a live rover receives, in both directions.

    Args:
        speed: maximum forward speed, m/s.
        yaw_rate: maximum yaw rate, rad/s.
        acceleration: maximum rate of change of the forward speed, m/s^2.
        yaw_acceleration: maximum rate of change of the yaw rate, rad/s^2.
    """

    speed: float
    yaw_rate: float
    acceleration: float
    yaw_acceleration: float

    @classmethod
    def from_robot(cls, robot: Robot) -> CommandLimits:
        """Creates the limits of a robot's drive."""
        drive = robot.drive
        acceleration, yaw_acceleration = drive.max_linear_acceleration, drive.max_angular_acceleration
        return cls(drive.max_speed, drive.max_yaw_rate, acceleration, yaw_acceleration)


class CommandLimiter:
    """Limits commands, and suppresses oscillation of the yaw rate.

    Policies are trained on a drive that lags. On a drive without lag, the yaw rate of the heading PID changes its sign
    in nearly every step. Two measures prevent that: the yaw rate changes only as fast as the robot's drive does in
    training, and a change of the turning direction requires a desired yaw rate of at least :data:`MIN_REVERSAL`. With
    less, the rover stops turning.

    Example:
        >>> limiter = CommandLimiter(CommandLimits(speed=1.0, yaw_rate=2.0, acceleration=5.0, yaw_acceleration=4.0))
        >>> limiter((0.9, 0.0), desired=(1.5, -3.0), dt=0.05)
        (1.0, -0.2)
    """

    def __init__(self, limits: CommandLimits) -> None:
        self.limits = limits
        self._direction = 0.0

    def reset(self) -> None:
        """Clears the turning direction at the start of an episode."""
        self._direction = 0.0

    def __call__(self, last: tuple[float, float], desired: tuple[float, float], dt: float) -> tuple[float, float]:
        """Returns the next command, forward speed (m/s) and yaw rate (rad/s), on the way from ``last`` to ``desired``.

        Args:
            last: last command.
            desired: desired command.
            dt: time since the last command, s.

        Raises:
            ValueError: if the desired command is not finite.
        """
        if not all(map(math.isfinite, desired)):
            raise ValueError(f"a command must be finite, got {desired[0]} m/s and {desired[1]} rad/s")
        limits = self.limits
        speed = _approach(last[0], _clip(desired[0], limits.speed), limits.acceleration * dt)
        reverses_little = desired[1] * self._direction < 0 and abs(desired[1]) < MIN_REVERSAL
        yaw_rate = 0.0 if reverses_little else _clip(desired[1], limits.yaw_rate)
        yaw_rate = _approach(last[1], yaw_rate, limits.yaw_acceleration * dt)
        if yaw_rate:
            self._direction = math.copysign(1.0, yaw_rate)
        return speed, yaw_rate


def _approach(last: float, desired: float, step: float) -> float:
    return max(last - step, min(last + step, desired))


def _clip(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
