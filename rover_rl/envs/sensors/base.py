"""``Sensor``: an entry of the observation, what it reads, and how networks read it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import ClassVar
from zlib import crc32

import torch
from torch import Tensor

from rover_rl.checks import MAX_COUNT, check_at_least
from rover_rl.envs.config import Randomization
from rover_rl.envs.localization import SensedPose
from rover_rl.envs.perception import Perception
from rover_rl.envs.rng import random_bits, to_normal, to_unit
from rover_rl.envs.sensors.surroundings import Surroundings
from rover_rl.envs.specs import Bounds
from rover_rl.sims import RoverState
from rover_rl.sims.rotations import rotate


@dataclass(frozen=True)
class SensorInput:
    """What sensors read from.

    Attributes:
        truth: true state of the rovers, ``[N]``.
        sensed: state of the rovers as lidar, IMU and wheel odometry report it, ``[N]``.
        pose: pose that the sensors report, ``[N]``.
        target: distance (m) and relative angle (rad) of the goals as seen from that pose, ``[N, 2]``.
        steps: number of steps of each row's episode, int64 ``[N, 1]``.
        keys: random keys of the episodes, int64 ``[N, 1]``.
        surroundings: ground and obstacles: heights and rays in the world frame.
    """

    truth: Perception
    sensed: Perception
    pose: SensedPose
    target: Tensor
    steps: Tensor
    keys: Tensor
    surroundings: Surroundings

    def scan(self, mount: Sequence[float], directions: Sequence[Sequence[float]]) -> Tensor:
        """Casts rays from a point of the rover, and returns their ranges, ``[N, K]``, m; ``inf`` for no return.

        Args:
            mount: position in the frame of the rover, whose origin is on the ground and whose axes point forward, left
                and up, m.
            directions: K directions in this frame, of any length but 0.
        """
        rover = self.truth.rover
        position, orientation = rover.position[:, None], rover.orientation[:, None]
        rays = rotate(orientation, position.new_tensor(directions))
        origins = position + rotate(orientation, position.new_tensor(mount))
        return self.surroundings.cast(origins.expand_as(rays), rays)

    def uniform(self, sensor: Sensor, count: int) -> Tensor:
        """Returns random numbers in [0, 1) of a sensor, float32 ``[N, count]``.

        They depend on the seed of the row, the episode, the step and the name of the sensor alone, so that they are
        the same at each call in a step.
        """
        return to_unit(random_bits(self.keys, _stream(sensor, "uniform"), self.steps, count))

    def normal(self, sensor: Sensor, count: int) -> Tensor:
        """Returns standard normal random numbers of a sensor, float32 ``[N, count]``: see :meth:`uniform`."""
        return to_normal(random_bits(self.keys, _stream(sensor, "normal"), self.steps, count))


def _stream(sensor: Sensor, kind: str) -> int:
    # Small numbers are streams of the package.
    return (1 << 32) + crc32(f"{sensor.name} {kind}".encode())


@dataclass(frozen=True, kw_only=True)
class Sensor(ABC):
    """An entry of the observation.

    Sensors of one's own are given to :func:`rover_rl.make_env` (``sensors``) or to the command line (``--sensors``). A
    subclass is a frozen dataclass whose fields are the settings of the sensor. It defines :attr:`bounds` and
    :meth:`read`, and overrides what else differs.

    Args:
        name: key of the entry.
        period: number of steps from one reading to the next. Readings stay the same in between.

    Attributes:
        clips: whether the value can leave the bounds, and is clipped to them.
        mirror_signs: signs of the left-right mirror image of a value. Empty if it does not change.

    Raises:
        ValueError: if the period is less than 1, or the name is no identifier.
    """

    name: str
    period: int = 1
    clips: ClassVar[bool] = True
    mirror_signs: ClassVar[tuple[float, ...]] = ()

    def __post_init__(self) -> None:
        check_at_least(1, MAX_COUNT, period=self.period)
        if not self.name.isidentifier():
            raise ValueError(f"the name of a sensor must be an identifier, got {self.name!r}")

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
