"""Heading controller: PID from a desired heading to a yaw rate."""

from __future__ import annotations

import torch
from torch import Tensor

from rover_rl.envs.config import HeadingGains
from rover_rl.sims.rotations import wrap_angle


class HeadingController:
    """PID controller per row that turns the rover toward a heading.

    Args:
        num_envs: number of rows.
        gains: gains of the PID. ``None`` uses the contract's.
        device: device of the controller's state.
    """

    def __init__(
        self, num_envs: int, gains: HeadingGains | None = None, device: torch.device | str | None = None
    ) -> None:
        self.gains = gains or HeadingGains()
        self._error = torch.zeros(num_envs, 1, device=device)
        self._integral = torch.zeros(num_envs, 1, device=device)

    def reset(self, mask: Tensor) -> None:
        """Clears the error and integral of the rows of ``mask`` (bool ``[N, 1]``)."""
        self._error = self._error.masked_fill(mask, 0.0)
        self._integral = self._integral.masked_fill(mask, 0.0)

    def __call__(self, desired: Tensor, current: Tensor, dt: Tensor, active: Tensor | None = None) -> Tensor:
        """Returns the yaw rate that turns the rover toward the desired heading, ``[N, 1]``, rad/s.

        Args:
            desired: desired heading in the world frame, ``[N, 1]``, rad.
            current: current heading in the world frame, ``[N, 1]``, rad.
            dt: time since the previous call, ``[N, 1]``, s.
            active: rows to update, bool ``[N, 1]``. The other rows keep their error and integral.
        """
        error = wrap_angle(desired - current)
        integral = torch.addcmul(self._integral, error, dt)
        change = (error - self._error) / dt
        gains = self.gains
        rate = gains.kp * error + gains.ki * integral + gains.kd * change
        self._error = error if active is None else torch.where(active, error, self._error)
        self._integral = integral if active is None else torch.where(active, integral, self._integral)
        return rate.clamp(-gains.max_output, gains.max_output)
