"""Checks of what users hand to :class:`~rover_rl.envs.rover.RoverEnv`: actions, starts and goals."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor


def checked_action(action: Tensor, batch_size: Sequence[int], bounds: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """The action of each row clipped to its bounds, ``[N, 2]``, and which rows were not finite, bool ``[N, 1]``.

    On the CPU those raise. On an accelerator they are flagged, because the check would synchronize with the device.

    Args:
        action: actions, ``[*batch_size, 2]``.
        batch_size: ``[N]``, or ``[]`` of an unbatched environment.
        bounds: lower and upper bounds, ``[2]`` each.

    Raises:
        ValueError: for another shape, or numbers that are not finite.
    """
    expected = (*batch_size, 2)
    if action.shape != expected:
        raise ValueError(f"action must have shape {expected}, got {tuple(action.shape)}")
    action = action.reshape(-1, 2)
    invalid = ~torch.isfinite(action).all(-1, keepdim=True)
    if action.device.type == "cpu" and invalid.any():
        rows = invalid.squeeze(-1).nonzero().squeeze(-1).tolist()
        raise ValueError(f"action must be finite numbers, got NaN or infinity in rows {rows}")
    return torch.clamp(action, *bounds), invalid


def checked_place(
    key: str,
    value: Tensor | None,
    tensordict: TensorDictBase | None,
    shape: Sequence[int],
    device: torch.device,
) -> Tensor | None:
    """Starts or goals that the user gives, ``[N, k]``; ``None`` if there are none.

    Args:
        key: ``"start"`` or ``"goal"``.
        value: argument of ``reset()``.
        tensordict: reset tensordict, which may hold them instead.
        shape: expected shape, ``[*batch_size, k]``.
        device: device of the result.

    Raises:
        ValueError: for another shape, or numbers that are not finite.
    """
    if value is None and tensordict is not None:
        value = tensordict.get(key, None)
    if value is None:
        return None
    value = torch.as_tensor(value, dtype=torch.float32, device=device)
    if value.shape != tuple(shape) or not torch.isfinite(value).all():
        raise ValueError(f"{key} must be finite numbers of shape {tuple(shape)}, got shape {tuple(value.shape)}")
    return value.reshape(-1, shape[-1])
