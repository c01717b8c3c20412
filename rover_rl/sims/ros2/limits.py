"""Limits of what a live rover is commanded: speed, yaw rate and their rates of change."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rover_rl.sims.robots import Robot

LEAST_REVERSAL = 0.5
"""Yaw rate that must be asked for before a rover changes its turning direction, rad/s. The heading PID asks for it at a
heading error of 14 degrees."""


@dataclass(frozen=True)
class CommandLimits:
    """The highest commands that a live rover is sent, in both directions.

    Args:
        speed: forward speed, m/s.
        yaw_rate: rad/s.
        acceleration: change of the forward speed, m/s^2.
        yaw_acceleration: change of the yaw rate, rad/s^2.

    Raises:
        ValueError: for a limit that is not positive and finite.
    """

    speed: float
    yaw_rate: float
    acceleration: float
    yaw_acceleration: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < math.inf:
                raise ValueError(f"the limit of the {name.replace('_', ' ')} must be positive and finite, got {value}")

    @classmethod
    def of(cls, robot: Robot) -> CommandLimits:
        """The limits of a robot's drive."""
        return cls(
            speed=robot.max_speed,
            yaw_rate=robot.max_yaw_rate,
            acceleration=robot.max_linear_acceleration,
            yaw_acceleration=robot.max_angular_acceleration,
        )


class CommandLimiter:
    """Keeps commands within their limits, and the yaw rate from oscillating.

    Policies are trained on a drive that lags. On one that does not, the yaw rate that the heading PID asks for changes
    its sign in nearly every step. Two measures prevent that: the yaw rate changes only as fast as the robot's own drive
    would in training, and a change of the turning direction is carried out only if at least :data:`LEAST_REVERSAL` is
    asked for; with less the rover stops turning.

    Args:
        limits: of the commands.

    Example:
        >>> limiter = CommandLimiter(CommandLimits(speed=1.0, yaw_rate=2.0, acceleration=5.0, yaw_acceleration=4.0))
        >>> limiter((0.9, 0.0), wanted=(1.5, -3.0), dt=0.05)
        (1.0, -0.2)
    """

    def __init__(self, limits: CommandLimits) -> None:
        self.limits = limits
        self._direction = 0.0

    def reset(self) -> None:
        """Forgets the turning direction: an episode begins."""
        self._direction = 0.0

    def __call__(self, last: tuple[float, float], wanted: tuple[float, float], dt: float) -> tuple[float, float]:
        """The command on the way from ``last`` to ``wanted``.

        Args:
            last: forward speed (m/s) and yaw rate (rad/s) of the command before.
            wanted: the same of the command that is asked for.
            dt: time since the command before, s.

        Raises:
            ValueError: for a command that is not finite.
        """
        if not all(map(math.isfinite, wanted)):
            raise ValueError(f"a command must be finite, got {wanted[0]} m/s and {wanted[1]} rad/s")
        limits = self.limits
        speed = _approach(last[0], _clip(wanted[0], limits.speed), limits.acceleration * dt)
        turn = _clip(self._without_small_reversals(wanted[1]), limits.yaw_rate)
        turn = _approach(last[1], turn, limits.yaw_acceleration * dt)
        if turn:
            self._direction = math.copysign(1.0, turn)
        return speed, turn

    def _without_small_reversals(self, turn: float) -> float:
        reverses = turn * self._direction < 0
        return 0.0 if reverses and abs(turn) < LEAST_REVERSAL else turn


def _approach(last: float, wanted: float, step: float) -> float:
    return max(last - step, min(last + step, wanted))


def _clip(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
