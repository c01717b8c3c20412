"""TorchRL specs of observation, action, reward and done flags, the bounds that they are built from, and devices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded

from rover_rl.envs.config import ActionConfig, EnvConfig
from rover_rl.envs.privileged import FEATURES as PRIVILEGED
from rover_rl.envs.task import EVENTS, StepEvent


@dataclass(frozen=True)
class Bounds:
    """Lower and upper bounds of one entry of the observation or action.

    Attributes:
        low: lower bound of each feature.
        high: upper bound of each feature.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    def tensors(self, device: torch.device | str | None) -> tuple[Tensor, Tensor]:
        """Returns the lower and upper bounds as tensors, float32 ``[features]`` each."""
        return torch.tensor(self.low, device=device), torch.tensor(self.high, device=device)


def action_bounds(action: ActionConfig) -> Bounds:
    """Returns the bounds of forward speed (m/s), heading offset (rad) and, if there is one, speed to the left (m/s).

    Where ``action`` states no speed, it is that of the default robot: see ``EnvConfig.bounded_action`` for others.
    """
    if action.min_speed is None or action.max_speed is None:
        action = action.for_robot(EnvConfig.robot)
    assert action.min_speed is not None
    assert action.max_speed is not None
    sideways = (action.max_sideways,) if action.max_sideways else ()
    return Bounds(
        low=(action.min_speed, -action.max_turn, *(-side for side in sideways)),
        high=(action.max_speed, action.max_turn, *sideways),
    )


ACTION = action_bounds(ActionConfig())
"""Bounds of the contract's action: forward speed (m/s) and heading offset (rad)."""


def bounded_spec(bounds: Bounds, batch_size: Sequence[int], device: torch.device | str | None) -> Bounded:
    """Creates a float32 spec of shape ``[*batch_size, features]``."""
    low, high = (side.expand(*batch_size, -1) for side in bounds.tensors(device))
    return Bounded(low=low.clone(), high=high.clone(), dtype=torch.float32, device=device)


def observation_spec(
    bounds: Mapping[str, Bounds],
    batch_size: Sequence[int],
    device: torch.device | str | None,
    privileged: bool = False,
    several_worlds: bool = False,
    movers: bool = False,
) -> Composite:
    """Creates the spec of the observation and the nested ``outcome``.

    Args:
        bounds: bounds of each entry, those of its sensor.
        batch_size: batch size of the environment.
        device: device of the environment.
        privileged: whether to add the nested ``privileged`` observation.
        several_worlds: whether to add the index of the world to ``outcome``.
        movers: whether to add what happens between rover and movers to ``outcome``.
    """
    entries = {key: bounded_spec(each, batch_size, device) for key, each in bounds.items()}
    if privileged:
        entries["privileged"] = _privileged_spec(batch_size, device)
    outcome = _outcome_spec(batch_size, device, several_worlds, movers)
    return Composite(**entries, outcome=outcome, shape=batch_size, device=device)


def _privileged_spec(batch_size: Sequence[int], device: torch.device | str | None) -> Composite:
    entries = {
        key: Unbounded(shape=(*batch_size, features), dtype=torch.float32, device=device)
        for key, features in PRIVILEGED.items()
    }
    return Composite(**entries, shape=batch_size, device=device)


def done_spec(batch_size: Sequence[int], device: torch.device | str | None) -> Composite:
    """Creates the spec of ``done``, ``terminated`` and ``truncated``, bool ``[*batch_size, 1]``."""
    keys = ("done", "terminated", "truncated")
    return Composite(**{key: _flag(batch_size, device) for key in keys}, shape=batch_size, device=device)


def reward_spec(batch_size: Sequence[int], device: torch.device | str | None) -> Unbounded:
    """Creates the spec of the reward, float32 ``[*batch_size, 1]``."""
    return Unbounded(shape=(*batch_size, 1), dtype=torch.float32, device=device)


def _outcome_spec(
    batch_size: Sequence[int], device: torch.device | str | None, several_worlds: bool, movers: bool
) -> Composite:
    shape = (*batch_size, 1)
    of_movers = {
        "mover_contact": _flag(batch_size, device),
        "mover_distance": Unbounded(shape=shape, device=device),
        "mover_speed": Unbounded(shape=shape, device=device),
    }
    return Composite(
        **{event: _flag(batch_size, device) for event in EVENTS},
        phase=Bounded(low=0, high=max(StepEvent), shape=shape, dtype=torch.int64, device=device),
        progress=Unbounded(shape=shape, device=device),
        alignment=Bounded(low=-1.0, high=1.0, shape=shape, device=device),
        linear_velocity=Unbounded(shape=shape, device=device),
        angular_velocity=Unbounded(shape=shape, device=device),
        steps=Unbounded(shape=shape, dtype=torch.int64, device=device),
        total_steps=Unbounded(shape=shape, dtype=torch.int64, device=device),
        **({"world": Unbounded(shape=shape, dtype=torch.int64, device=device)} if several_worlds else {}),
        **(of_movers if movers else {}),
        shape=batch_size,
        device=device,
    )


def _flag(batch_size: Sequence[int], device: torch.device | str | None) -> Binary:
    return Binary(n=1, shape=(*batch_size, 1), dtype=torch.bool, device=device)


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
