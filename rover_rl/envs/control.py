"""From an action to a velocity command: validation, heading controller and delay. Validation of starts and goals."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.envs.config import HeadingGains
from rover_rl.rng import random_bits, to_index
from rover_rl.sims.rotations import wrap_angle

_LATENCY = 3
"""Stream of random numbers."""


def checked_action(action: Tensor, batch_size: Sequence[int], bounds: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Validates actions and clips them to their bounds.

    Values that are not finite raise an error on the CPU. On an accelerator they are only flagged, because raising an
    error would require synchronization with the device.

    Args:
        action: actions, ``[*batch_size, A]``.
        batch_size: batch size of the environment, ``[N]`` or ``[]``.
        bounds: lower and upper bounds, ``[A]`` each.

    Returns:
        Clipped actions, ``[N, A]``, and rows with values that are not finite, bool ``[N, 1]``.

    Raises:
        ValueError: if the shape is wrong, or values are not finite.
    """
    expected = (*batch_size, len(bounds[0]))
    if action.shape != expected:
        raise ValueError(f"action must have shape {expected}, got {tuple(action.shape)}")
    action = action.reshape(-1, len(bounds[0]))
    invalid = ~torch.isfinite(action).all(-1, keepdim=True)
    if action.device.type == "cpu" and invalid.any():
        rows = invalid.squeeze(-1).nonzero().squeeze(-1).tolist()
        raise ValueError(f"action must be finite numbers, got NaN or infinity in rows {rows}")
    return torch.clamp(action, *bounds), invalid


def checked_place(
    key: str, value: Tensor | None, tensordict: TensorDictBase | None, shape: Sequence[int], device: torch.device
) -> Tensor | None:
    """Validates start poses or goals. Returns ``[N, k]``, or ``None`` if the user gives none.

    Args:
        key: ``"start"`` or ``"goal"``.
        value: argument of ``reset()``, or ``None``.
        tensordict: reset tensordict, whose entry ``key`` is used if ``value`` is ``None``.
        shape: expected shape, ``[*batch_size, k]``.
        device: device of the result.

    Raises:
        ValueError: if the shape is wrong, or values are not finite.
    """
    if value is None and tensordict is not None:
        value = tensordict.get(key, None)
    if value is None:
        return None
    value = torch.as_tensor(value, dtype=torch.float32, device=device)
    if value.shape != tuple(shape) or not torch.isfinite(value).all():
        raise ValueError(f"{key} must be finite numbers of shape {tuple(shape)}, got shape {tuple(value.shape)}")
    return value.reshape(-1, shape[-1])


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


class CommandDelay:
    """Delays each row's commands by a number of control steps.

    Args:
        latency: range of the delay, control steps.
        num_envs: number of rows.
        size: number of components of a command.
        device: device of the commands.

    Attributes:
        steps: current delay of each row, control steps, int64 ``[N, 1]``.
    """

    def __init__(self, latency: tuple[int, int], num_envs: int, size: int, device: torch.device) -> None:
        self._min, self._max = latency
        self.steps = torch.zeros(num_envs, 1, dtype=torch.int64, device=device)
        # Queue of commands, newest first.
        self._pending = torch.zeros(num_envs, self._max + 1, size, device=device)

    def reset(self, mask: Tensor, keys: Tensor) -> None:
        """Draws a new delay for the rows of ``mask`` (bool ``[N, 1]``) and discards their pending commands."""
        if not self._max:
            return
        span = torch.full_like(self.steps, self._max - self._min + 1)
        drawn = self._min + to_index(random_bits(keys, _LATENCY, 0, 1), span)
        self.steps = torch.where(mask, drawn, self.steps)
        self._pending = self._pending.masked_fill(mask[..., None], 0.0)

    def __call__(self, command: Tensor, active: Tensor | None) -> Tensor:
        """Queues a command and returns the delayed command, ``[N, size]``.

        Args:
            command: forward speed (m/s), yaw rate (rad/s) and further components, ``[N, size]``.
            active: rows to advance, bool ``[N, 1]``. No time passes for the others. ``None`` means all rows.
        """
        if not self._max:
            return command
        pending = torch.cat((command[:, None], self._pending[:, :-1]), 1)
        self._pending = pending if active is None else torch.where(active[..., None], pending, self._pending)
        return pending.gather(1, self.steps[..., None].expand(-1, 1, pending.shape[-1])).squeeze(1)
