"""``Sensor``: an entry of the observation, what it reads, and how networks read it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import torch
from torch import Tensor

from rover_rl.checks import MAX_COUNT, check_at_least
from rover_rl.envs.config import Randomization
from rover_rl.envs.perception import Perception
from rover_rl.envs.specs import Bounds
from rover_rl.sims import RoverState


@dataclass(frozen=True)
class SensorInput:
    """What sensors read from.

    Attributes:
        sensed: state of the rovers, ``[N]``, as lidar, IMU and wheel odometry report it.
        target: distance (m) and relative angle (rad) of the goals in the sensed state, ``[N, 2]``.
        steps: number of steps of each row's episode, int64 ``[N, 1]``.
    """

    sensed: Perception
    target: Tensor
    steps: Tensor


@dataclass(frozen=True, kw_only=True)
class Sensor(ABC):
    """An entry of the observation.

    A subclass is a frozen dataclass whose fields are the settings of the sensor. It defines :attr:`bounds` and
    :meth:`read`, and overrides what else differs.

    Args:
        name: key of the entry.
        period: number of steps from one reading to the next. Readings stay the same in between.

    Attributes:
        clips: whether the value can leave the bounds, and is clipped to them.
        mirror_signs: signs of the left-right mirror image of a value. Empty if it does not change.

    Raises:
        ValueError: if the period is less than 1.
    """

    name: str
    period: int = 1
    clips: ClassVar[bool] = True
    mirror_signs: ClassVar[tuple[float, ...]] = ()

    def __post_init__(self) -> None:
        check_at_least(1, MAX_COUNT, period=self.period)

    @property
    @abstractmethod
    def bounds(self) -> Bounds:
        """Bounds of a value."""

    @abstractmethod
    def read(self, inputs: SensorInput) -> Tensor:
        """Returns the value of every row, float32 ``[N, k]``."""

    def sense(self, noise: Randomization, rover: RoverState, keys: Tensor, step: Tensor) -> dict[str, Tensor]:
        """Returns the fields of the rovers' state that the noise of this sensor changes, by name.

        Args:
            noise: parameters of the noise.
            rover: true state of the rovers, ``[N]``.
            keys: random keys of the episodes, ``[N, 1]``.
            step: index of the step in its episode, ``[N, 1]``.
        """
        return {}

    @property
    def features(self) -> int:
        """Number of features that a network reads."""
        return self.encode(torch.zeros(len(self.bounds.low))).shape[-1]

    def encode(self, value: Tensor) -> Tensor:
        """Returns what a network reads, ``[..., features]``: by default the value, scaled by the bounds to [-1, 1]."""
        low, high = self.bounds.tensors(value.device)
        return (2 * value - low - high) / (high - low)

    def mirror(self, value: Tensor) -> Tensor:
        """Returns the value ``[..., k]`` in the world mirrored left to right."""
        return mirrored_signs(self.mirror_signs, value) if self.mirror_signs else value


def mirrored_signs(signs: tuple[float, ...], value: Tensor) -> Tensor:
    """Returns ``value [..., k]`` times the signs of its mirror image."""
    return value * _signs(signs, value.device)


@cache
def _signs(signs: tuple[float, ...], device: torch.device) -> Tensor:
    return torch.tensor(signs, device=device)
