"""``ObservationEncoder``: features of an observation, scaled for networks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from rover_rl.envs.config import LidarConfig
from rover_rl.envs.observation import observation_bounds
from rover_rl.envs.seen_map.seen_map import ROUTE, ROUTE_BOUNDS

DEFAULT_KEYS = ("lidar", "imu", "target", "velocities")
"""Entries of the observation that networks read by default. With the pose, a policy would memorize the map."""
WAVELENGTHS = (64.0, 16.0, 4.0)
"""Wavelengths of the sine and cosine features of a position, m. The largest world is 64 m wide."""


class ObservationEncoder(nn.Module):
    """Encodes observations as features of about [-1, 1].

    The bounds of the observation space are not suitable as scales: distances of a few meters would become so small that
    a policy could hardly use them. The scales are constants, so that a policy needs no running statistics. Lidar
    readings are logarithmic, since centimeters matter only at short range. Angles are encoded as sine and cosine, and
    tilts in units of about 20 degrees.

    Args:
        keys: entries of the observation to read, some of ``lidar``, ``imu``, ``target``, ``velocities``, ``pose``, and
            ``route`` (:class:`~rover_rl.envs.transforms.route_observation.RouteObservation`).
        lidar_points: number of readings in ``lidar``.
        north_up: whether to add lidar and target in map orientation: rotated by the yaw, so that they do not change
            when the rover turns in place. Requires ``lidar``, ``imu`` and ``target``.

    Attributes:
        features: number of features.

    Raises:
        ValueError: for an unknown key, or ``north_up`` without the keys that it requires.

    Example:
        >>> encoder = ObservationEncoder(("lidar", "target"))
        >>> encoder(torch.full((1, 32), 12.0), torch.tensor([[5.0, 0.0]])).shape
        torch.Size([1, 37])
    """

    def __init__(self, keys: Sequence[str] = DEFAULT_KEYS, lidar_points: int = 32, north_up: bool = False) -> None:
        super().__init__()
        self.keys = tuple(keys)
        if north_up and not {"lidar", "imu", "target"} <= set(keys):
            raise ValueError(f"north_up needs lidar, imu and target, got {self.keys}")
        self._lidar_points, self._north_up, self._has_yaw = lidar_points, north_up, north_up or "pose" in keys
        self._bounds = {**observation_bounds(LidarConfig(points=lidar_points)), ROUTE: ROUTE_BOUNDS}
        if unknown := [key for key in self.keys if key not in self._bounds]:
            raise ValueError(f"the observation has no entries {unknown}; use some of {[*self._bounds]}")
        sizes = {key: len(bounds.low) for key, bounds in self._bounds.items()}
        sizes |= {"imu": 4 if self._has_yaw else 2, "target": 5, "pose": 4 * len(WAVELENGTHS) + 1, ROUTE: 13}
        self.features = sum(sizes[key] for key in self.keys) + (lidar_points + 4 if north_up else 0)

    def forward(self, *observation: Tensor) -> Tensor:
        """Encodes the entries named in ``keys``, in this order (m, rad, m/s, rad/s): ``[..., features]``.

        Raises:
            ValueError: if the lidar has another number of readings than ``lidar_points``.
        """
        entries = dict(zip(self.keys, observation, strict=True))
        if "lidar" in entries and (points := entries["lidar"].shape[-1]) != self._lidar_points:
            raise ValueError(f"the policy reads {self._lidar_points} lidar points, got {points}")
        parts = [self._encode(key, value) for key, value in entries.items()]
        if self._north_up:
            parts.append(self._map_oriented(entries["lidar"], entries["imu"][..., 2:], entries["target"]))
        return torch.cat(parts, -1)

    def _encode(self, key: str, value: Tensor) -> Tensor:
        """Encodes one entry. Entries without an encoding of their own are scaled by their bounds to [-1, 1]."""
        encode = getattr(self, f"_{key}", None)
        if encode is not None:
            return encode(value)
        low, high = self._bounds[key].tensors(value.device)
        return (2 * value - low - high) / (high - low)

    def _map_oriented(self, ranges: Tensor, yaw: Tensor, target: Tensor) -> Tensor:
        """Encodes lidar and target rotated by the yaw; readings are interpolated between neighbors."""
        points = ranges.shape[-1]
        shifted = (torch.arange(points, device=yaw.device) - yaw * (points / (2 * math.pi))) % points
        floor = shifted.floor()
        index = floor.long() % points
        left, right = ranges.gather(-1, index), ranges.gather(-1, (index + 1) % points)
        ranges = torch.lerp(left, right, shifted - floor)
        distance, angle = target.split(1, -1)
        direction = torch.cat(((angle + yaw).sin(), (angle + yaw).cos()), -1)
        return torch.cat((self._lidar(ranges), direction, direction * distance / 4), -1)

    def _lidar(self, ranges: Tensor) -> Tensor:
        return ranges.log1p() / 1.3 - 1

    def _imu(self, angles: Tensor) -> Tensor:
        """Encodes pitch and roll, and the yaw only for policies of one map."""
        tilt, yaw = angles[..., :2] * 3, angles[..., 2:]
        return torch.cat((tilt, yaw.sin(), yaw.cos()), -1) if self._has_yaw else tilt

    def _target(self, target: Tensor) -> Tensor:
        distance, angle = target.split(1, -1)
        return torch.cat((distance / 5 - 1, distance.log1p() - 1, angle.sin(), angle.cos(), angle / math.pi), -1)

    def _route(self, route: Tensor) -> Tensor:
        """Encodes two corners like targets, and the length, for which no path counts as none left."""
        first, second, length = route.split((2, 2, 1), -1)
        left = length.clamp(min=0)
        rest = (left / 10 - 1, left.log1p() - 1, (length < 0).to(length.dtype))
        return torch.cat((self._target(first), self._target(second), *rest), -1)

    def _velocities(self, velocities: Tensor) -> Tensor:
        speed, yaw_rate = velocities.split(1, -1)
        return torch.cat((speed, yaw_rate / 3), -1)

    def _pose(self, position: Tensor) -> Tensor:
        wave_numbers = 2 * math.pi / position.new_tensor(WAVELENGTHS)
        phase = (position[..., :2, None] * wave_numbers).flatten(-2)
        return torch.cat((phase.sin(), phase.cos(), position[..., 2:]), -1)
