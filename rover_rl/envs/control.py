"""The heading controller: from an action to a twist command."""

from __future__ import annotations

import torch
from torch import Tensor

from rover_rl.envs.config import HeadingGains
from rover_rl.sims.rotations import wrap_angle


class HeadingController:
    """A PID a row that turns the rover towards a heading.

    Args:
        num_envs: rows.
        gains: of the PID.
        device: where the rows live.
    """

    def __init__(
        self, num_envs: int, gains: HeadingGains | None = None, device: torch.device | str | None = None
    ) -> None:
        self.gains = gains or HeadingGains()
        self._error = torch.zeros(num_envs, 1, device=device)
        self._integral = torch.zeros(num_envs, 1, device=device)

    def reset(self, mask: Tensor) -> None:
        """Forgets error and integral of the rows of ``mask`` (bool ``[N, 1]``)."""
        self._error = self._error.masked_fill(mask, 0.0)
        self._integral = self._integral.masked_fill(mask, 0.0)

    def __call__(self, desired: Tensor, current: Tensor, dt: Tensor, active: Tensor | None = None) -> Tensor:
        """Yaw rate in rad/s, ``[N, 1]``, that brings ``current`` heading to ``desired``.

        Args:
            desired, current: headings in the world, ``[N, 1]``, rad.
            dt: time since the call before, ``[N, 1]``, s.
            active: bool ``[N, 1]``; the other rows keep their error and integral.
        """
        error = wrap_angle(desired - current)
        integral = torch.addcmul(self._integral, error, dt)
        change = (error - self._error) / dt
        gains = self.gains
        rate = gains.kp * error + gains.ki * integral + gains.kd * change
        self._error = error if active is None else torch.where(active, error, self._error)
        self._integral = integral if active is None else torch.where(active, integral, self._integral)
        return rate.clamp(-gains.max_output, gains.max_output)
