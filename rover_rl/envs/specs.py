"""TorchRL specs of observation, action and done flags, the bounds that they are built from, and devices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded

from rover_rl.envs.task import EVENTS, StepEvent

Device: TypeAlias = torch.device | str | None
UNOBSERVED = "_unobserved"
"""Entry of an input, of any value, whose step returns no observation: ``RoverEnv.observe`` makes it later."""


@dataclass(frozen=True)
class Bounds:
    """Lower and upper bounds of each feature of an entry of the observation or action."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def tensors(self, device: Device) -> tuple[Tensor, Tensor]:
        return torch.tensor(self.low, device=device), torch.tensor(self.high, device=device)


def bounded_spec(bounds: Bounds, batch_size: Sequence[int], device: Device) -> Bounded:
    low, high = (side.expand(*batch_size, -1) for side in bounds.tensors(device))
    return Bounded(low=low.clone(), high=high.clone(), dtype=torch.float32, device=device)


def vectors_spec(features: Mapping[str, int], batch_size: Sequence[int], device: Device) -> Composite:
    """Creates the spec of unbounded float32 vectors, by name and size."""
    entries = {name: Unbounded(shape=(*batch_size, size), device=device) for name, size in features.items()}
    return Composite(**entries, shape=batch_size, device=device)


def done_spec(batch_size: Sequence[int], device: Device) -> Composite:
    keys = ("done", "terminated", "truncated")
    return Composite({key: _flag(batch_size, device) for key in keys}, shape=batch_size, device=device)


def outcome_spec(
    batch_size: Sequence[int], device: Device, several_worlds: bool = False, movers: bool = False
) -> Composite:
    """Creates the spec of the nested ``outcome``, with the index of the world, and what happens with movers."""
    shape = (*batch_size, 1)

    def of(dtype: torch.dtype, *names: str) -> dict[str, Unbounded]:
        return {name: Unbounded(shape=shape, dtype=dtype, device=device) for name in names}

    entries = {event: _flag(batch_size, device) for event in EVENTS} | {
        "phase": Bounded(low=0, high=max(StepEvent), shape=shape, dtype=torch.int64, device=device),
        **of(torch.float32, "progress"),
        "alignment": Bounded(low=-1.0, high=1.0, shape=shape, device=device),
        **of(torch.float32, "linear_velocity", "angular_velocity"),
        **of(torch.int64, "steps", "total_steps", *["world"] * several_worlds),
    }
    if movers:
        entries |= {"mover_contact": _flag(batch_size, device), **of(torch.float32, "mover_distance", "mover_speed")}
    return Composite(entries, shape=batch_size, device=device)


def _flag(batch_size: Sequence[int], device: Device) -> Binary:
    return Binary(n=1, shape=(*batch_size, 1), dtype=torch.bool, device=device)


def available_device(device: torch.device | str) -> torch.device:
    """Returns a device, or raises ``ValueError`` with the available ones if PyTorch cannot use it."""
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
