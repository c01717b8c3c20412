"""Validation of user input to :class:`~rover_rl.envs.rover.RoverEnv`: actions, start poses and goals."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor


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
