"""Validation of PyTorch devices."""

from __future__ import annotations

import torch


def available_device(device: torch.device | str) -> torch.device:
    """Returns a device after checking that PyTorch can use it.

    Args:
        device: device or its name, for example ``"cuda:0"``.

    Raises:
        ValueError: if the device is not available. The message lists the available devices.

    Example:
        >>> available_device("cpu")
        device(type='cpu')
    """
    try:
        found = torch.device(device)
        torch.empty(0, device=found)
    except (RuntimeError, AssertionError, ImportError) as error:
        kind, count = torch.accelerator.current_accelerator(), torch.accelerator.device_count()
        available = ", ".join(["cpu", *(f"{kind}:{index}" for index in range(count))])
        raise ValueError(
            f"device={str(device)!r} is not available: PyTorch {torch.__version__} finds {available}"
        ) from error
    return found
