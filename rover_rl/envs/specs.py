"""The TensorDict specs, from one table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torchrl.data import Binary, Bounded, Composite, Unbounded

from rover_rl.envs.task import EVENTS, StepEvent


@dataclass(frozen=True)
class Bounds:
    """Lower and upper bound of each feature of one entry."""

    low: tuple[float, ...]
    high: tuple[float, ...]


ACTION = Bounds(low=(-1.0, -math.pi), high=(1.0, math.pi))
"""Forward speed (m/s) and heading offset (rad)."""


def observation_bounds(lidar_points: int, max_lidar_range: float) -> dict[str, Bounds]:
    """The contract's observation space: metres, radians, m/s and rad/s."""
    return {
        "lidar": Bounds((0.0,) * lidar_points, (max_lidar_range,) * lidar_points),
        "pose": Bounds((-30.0, -30.0, -10.0), (30.0, 30.0, 10.0)),
        "imu": Bounds((-math.pi,) * 3, (math.pi,) * 3),
        "target": Bounds((0.0, -math.pi), (100.0, math.pi)),
        "velocities": Bounds((-10.0, -10.0), (10.0, 10.0)),
    }


def bounded_spec(bounds: Bounds, batch_size: Sequence[int], device: torch.device | str | None) -> Bounded:
    """A float32 spec ``[*batch_size, features]``."""
    low, high = (torch.tensor(side, device=device).expand(*batch_size, -1) for side in (bounds.low, bounds.high))
    return Bounded(low=low.clone(), high=high.clone(), dtype=torch.float32, device=device)


def observation_spec(
    lidar_points: int, max_lidar_range: float, batch_size: Sequence[int], device: torch.device | str | None
) -> Composite:
    """The observation and the nested ``outcome``."""
    observation = {
        key: bounded_spec(bounds, batch_size, device)
        for key, bounds in observation_bounds(lidar_points, max_lidar_range).items()
    }
    return Composite(**observation, outcome=_outcome_spec(batch_size, device), shape=batch_size, device=device)


def done_spec(batch_size: Sequence[int], device: torch.device | str | None) -> Composite:
    """``done``, ``terminated`` and ``truncated``, bool ``[*batch_size, 1]``."""
    keys = ("done", "terminated", "truncated")
    return Composite(
        **{key: _flag(batch_size, device) for key in keys},
        shape=batch_size,
        device=device,
    )


def reward_spec(batch_size: Sequence[int], device: torch.device | str | None) -> Unbounded:
    """One float32 a row, ``[*batch_size, 1]``."""
    return Unbounded(shape=(*batch_size, 1), dtype=torch.float32, device=device)


def _outcome_spec(batch_size: Sequence[int], device: torch.device | str | None) -> Composite:
    shape = (*batch_size, 1)
    return Composite(
        **{event: _flag(batch_size, device) for event in EVENTS},
        phase=Bounded(low=0, high=max(StepEvent), shape=shape, dtype=torch.int64, device=device),
        progress=Unbounded(shape=shape, device=device),
        alignment=Bounded(low=-1.0, high=1.0, shape=shape, device=device),
        linear_velocity=Unbounded(shape=shape, device=device),
        angular_velocity=Unbounded(shape=shape, device=device),
        steps=Unbounded(shape=shape, dtype=torch.int64, device=device),
        total_steps=Unbounded(shape=shape, dtype=torch.int64, device=device),
        shape=batch_size,
        device=device,
    )


def _flag(batch_size: Sequence[int], device: torch.device | str | None) -> Binary:
    return Binary(n=1, shape=(*batch_size, 1), dtype=torch.bool, device=device)
