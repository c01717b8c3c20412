"""From an action to a velocity command: validation and heading controller. Validation of starts and goals."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.envs.config import HeadingGains
from rover_rl.rotations import wrap_angle


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
    # A policy may have another precision, and gradients, which end here.
    action = action.detach().reshape(-1, len(bounds[0])).to(bounds[0].dtype)
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
