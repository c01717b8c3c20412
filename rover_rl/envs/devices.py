"""Devices that PyTorch has."""

from __future__ import annotations

import torch


def available_device(device: torch.device | str) -> torch.device:
    """``device``, if PyTorch finds it on this machine.

    Raises:
        ValueError: if it does not.

    Example:
        >>> available_device("cpu")
        device(type='cpu')
    """
    try:
        found = torch.device(device)
        torch.empty(0, device=found)
    except (RuntimeError, AssertionError, ImportError) as error:
        kind, count = torch.accelerator.current_accelerator(), torch.accelerator.device_count()
        there = ", ".join(["cpu", *(f"{kind}:{index}" for index in range(count))])
        raise ValueError(
            f"device={str(device)!r} is not available: PyTorch {torch.__version__} finds {there}"
        ) from error
    return found
