"""Lidar: its readings and their noise, when it scans, and pooling of a raw scan to the nearest of each segment."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rover_rl.envs.config import LidarConfig, Randomization
from rover_rl.envs.rng import random_bits, to_normal
from rover_rl.envs.sensors.base import Sensor, SensorInput
from rover_rl.envs.specs import Bounds
from rover_rl.sims import RoverState

_NOISE = 4
"""Stream of random numbers."""


@dataclass(frozen=True, kw_only=True)
class Lidar(Sensor):
    """Nearest reading of each segment of the scan, ``[N, points]``, m.

    Args:
        name: key of the entry.
        period: number of steps from one scan to the next.
        points: number of readings.
        max_range: maximum of a reading, m.
    """

    name: str = "lidar"
    points: int = LidarConfig.points
    max_range: float = LidarConfig.max_range
    clips = False

    @property
    def bounds(self) -> Bounds:
        """Bounds of the readings, m."""
        return Bounds((0.0,) * self.points, (self.max_range,) * self.points)

    def read(self, inputs: SensorInput) -> Tensor:
        """Returns the pooled scan."""
        return inputs.sensed.readings

    def sense(self, noise: Randomization, rover: RoverState, keys: Tensor, step: Tensor) -> dict[str, Tensor]:
        """Changes the ranges at random, and loses some of them. A scan keeps its noise."""
        if not (noise.range_noise or noise.dropout):
            return {}
        ranges = rover.ranges
        bits = random_bits(keys, _NOISE, step - step % self.period, ranges.shape[-1])
        if noise.range_noise:
            # A range stays positive, a 0 (beam that starts inside a solid) stays 0, and inf (no return) stays inf.
            changed = (ranges + noise.range_noise * to_normal(bits)).clamp_min(0.001)
            ranges = torch.where(ranges > 0, changed, ranges)
        if noise.dropout:
            # The upper 16 bits. The noise uses the lower 48.
            lost = (bits >> 48 & 0xFFFF) < round(noise.dropout * 0x10000)
            ranges = ranges.masked_fill(lost, math.inf)
        return {"ranges": ranges}

    def encode(self, value: Tensor) -> Tensor:
        """Returns the logarithm of the readings, since centimeters matter only at short range."""
        return value.log1p() / 1.3 - 1

    def mirror(self, value: Tensor) -> Tensor:
        """Reverses the order of the readings.

        They are minima over segments of the scan, the first of which begins straight ahead, so that the mirror image is
        exact to one beam of the raw scan.
        """
        return value.flip(-1)


class LidarPooling:
    """Cleans raw scans and reduces each of ``points`` segments to its minimum.

    Segments consist of neighboring beams. The first segment starts straight ahead. Sizes differ by at most one beam and
    no beam is dropped. ``+inf`` and NaN become ``max_range``. ``-inf`` means that an obstacle is too close to measure
    (REP 117) and becomes 0. All readings are clipped to ``[0, max_range]``.

    Args:
        beams: number of beams of a raw scan.
        points: number of segments (the contract's ``lidar_points``).
        max_range: maximum of a reading (the contract's ``max_lidar_range``), m.
        device: device of the scans.

    Raises:
        ValueError: if there are fewer beams than points, no points, or the range is not positive and finite.

    Example:
        >>> pool = LidarPooling(beams=4, points=2, max_range=12.0)
        >>> pool(torch.tensor([[3.0, float("inf"), 1.0, 2.0]]))
        tensor([[3., 1.]])
    """

    def __init__(self, beams: int, points: int, max_range: float, device: torch.device | str | None = None) -> None:
        if points < 1:
            raise ValueError(f"lidar_points must be at least 1, got {points}")
        if beams < points:
            raise ValueError(f"lidar_beams must be at least lidar_points, got {beams} beams for {points} points")
        if not 0 < max_range < float("inf"):
            raise ValueError(f"max_lidar_range must be a positive number of meters, got {max_range}")
        self.beams = beams
        self.points = points
        self.max_range = float(max_range)
        self._gather = None if beams % points == 0 else _segments(beams, points).to(device)

    def __call__(self, ranges: Tensor) -> Tensor:
        """Pools ``ranges [N, beams]`` (m) to ``[N, points]``."""
        # NaN must be replaced before the minimum, which it would win. Clipping the fewer pooled readings is faster.
        ranges = torch.nan_to_num(ranges, nan=self.max_range, posinf=self.max_range, neginf=0.0)
        grouped = ranges.unflatten(-1, (self.points, -1)) if self._gather is None else ranges[..., self._gather]
        return grouped.amin(-1).clamp(0.0, self.max_range)


def scanning(steps: Tensor, period: int, device: torch.device) -> tuple[Tensor, ...]:
    """Returns which rovers scan after ``steps [N, 1]`` steps of their episodes, bool ``[N]``; nothing if all do."""
    return () if period == 1 else ((steps % period == 0).squeeze(-1).to(device),)


def _segments(beams: int, points: int) -> Tensor:
    """Returns the beam indices of each segment, ``[points, longest]``. Short segments repeat their last beam."""
    parts = torch.arange(beams).tensor_split(points)
    longest = max(len(part) for part in parts)
    return torch.stack([torch.cat((part, part[-1:].expand(longest - len(part)))) for part in parts])
