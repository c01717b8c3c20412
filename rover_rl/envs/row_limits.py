"""Limits of the commands of each row, as ``rover-rl drive`` applies them to a live rover."""

from __future__ import annotations

import torch
from torch import Tensor

from rover_rl.envs.config import LimitsConfig
from rover_rl.rng import between, random_bits
from rover_rl.robots.fleet import Fleet
from rover_rl.sims.command_limiter import CommandLimiter, CommandLimits

_LIMITS = 26
"""Stream of random numbers."""


class RowLimits:
    """Limits the commands of a batch of rovers.

    Args:
        config: limits.
        factors: range of the factor of all limits, drawn at each reset.
        fleet: robots of the rows, whose limits are those that are not stated.
        device: device of the commands.
    """

    def __init__(self, config: LimitsConfig, factors: tuple[float, float], fleet: Fleet, device: torch.device) -> None:
        self._factors, self._fleet = factors, fleet
        self._table = fleet.table(lambda robot: [*CommandLimits.of(robot, config)])
        self._limiter = CommandLimiter(config.min_reversal, len(fleet), device)
        self._last: Tensor | None = None
        self._factor: Tensor | float = 1.0

    def begin(self, mask: Tensor, keys: Tensor) -> None:
        """Begins episodes in the rows of ``mask`` (bool ``[N, 1]``): draws factors from their keys ``[N, 1]``."""
        self._limiter.reset(mask)
        if self._last is not None:
            self._last = self._last.masked_fill(mask, 0.0)
        if self._factors != (1.0, 1.0):
            self._factor = between(random_bits(keys, _LIMITS, 0, 1), self._factors)

    def __call__(self, command: Tensor, dt: Tensor, active: Tensor | None) -> Tensor:
        """Returns the commands within the limits, ``[N, A]``.

        Args:
            command: forward speed (m/s), yaw rate (rad/s) and further speeds (m/s), ``[N, A]``.
            dt: duration of a step, ``[N, 1]``, s.
            active: rows that take the step, bool ``[N, 1]``. ``None``: all.
        """
        last = torch.zeros_like(command) if self._last is None else self._last
        limits = self._table[self._fleet.index] * self._factor
        limited = self._limiter(last, command, dt, limits, active)
        self._last = limited if active is None else torch.where(active, limited, last)
        return limited
