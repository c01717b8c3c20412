"""Movers: what moves around the rover, as tracked in its lidar scans."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor

from rover_rl.envs.config import SCAN_POSE
from rover_rl.envs.mover_tracker import STATE, TRACKS, MoverTracker
from rover_rl.envs.seen_map.scans import in_world
from rover_rl.envs.sensors.base import Sensor, SensorInput, SensorSetup, mirrored_signs
from rover_rl.envs.sensors.suite import LIDAR_MASK, MOVERS
from rover_rl.envs.specs import Bounds

READ = ("lidar", "pose", "imu", SCAN_POSE, LIDAR_MASK)  # entries that the tracker reads, if they are there
COUNT = 12  # number of movers in the entry
NUMBERS = 5  # numbers of a mover: x, y, velocity along x and y, and radius
TRACKED = COUNT * NUMBERS  # numbers of all movers in the entry
BEARINGS = 24  # number of directions of a predicted scan
INSTANTS = (0.5, 1.0, 1.5, 2.5)  # times of the predicted scans from now, s
FARTHEST = 12.0  # range of a predicted scan in directions without a mover, m
NEAREST = 6  # number of movers that a network also reads one by one
SLACK = 0.25  # distance from a mover up to which readings belong to it, m


@dataclass(frozen=True, kw_only=True)
class Movers(Sensor):
    """Up to 12 movers around the rover, and the scans that they would give in the next seconds, ``[N, 156]``.

    Each mover has x and y in the base frame (m), its velocity over ground along these axes (m/s), and its radius (m),
    which is 0 where there is none: 60 numbers. They are tracked in the lidar scans (see
    :class:`~rover_rl.envs.mover_tracker.MoverTracker`), and those that come nearest in the next two seconds are first.
    The map of what has been seen leaves them out if the observation has this entry.

    The other 96 numbers are ranges (m) in 24 directions from where the rover is now, if the movers keep their
    velocity: in 0.5, 1, 1.5 and 2.5 s.
    """

    name: str = MOVERS
    clips = False
    delayed = None
    takes_long = True
    bounds = Bounds(
        (-30.0, -30.0, -20.0, -20.0, 0.0) * COUNT + (0.0,) * len(INSTANTS) * BEARINGS,
        (30.0, 30.0, 20.0, 20.0, 5.0) * COUNT + (FARTHEST,) * len(INSTANTS) * BEARINGS,
    )

    def reader(self, setup: SensorSetup) -> Callable[[SensorInput], Tensor]:
        return _Reader(self, setup)

    def encode(self, value: Tensor) -> Tensor:
        """Encodes the logarithm of the ranges; of the first six movers whether there is one, and all its numbers."""
        nearest = encoded(movers_of(value)[..., :NEAREST, :])
        return torch.cat((value[..., TRACKED:].log1p() / 1.3 - 1, nearest.flatten(-2)), -1)

    def mirror(self, value: Tensor) -> Tensor:
        """Mirrors the movers and the scans: direction b becomes -b."""
        movers = mirrored_signs((1.0, -1.0, 1.0, -1.0, 1.0) * COUNT, value[..., :TRACKED])
        scans = value[..., TRACKED:].unflatten(-1, (len(INSTANTS), BEARINGS)).flip(-1).roll(1, -1)
        return torch.cat((movers, scans.flatten(-2)), -1)


class _Reader:
    def __init__(self, sensor: Movers, setup: SensorSetup) -> None:
        rows, device, self._period = len(setup.fleet), setup.fleet.index.device, sensor.period
        self._tracker = MoverTracker(setup.fleet, setup.lidar, sensor.period * setup.control_dt)
        self._state = torch.zeros(rows, TRACKS * STATE, device=device)
        self._values = torch.zeros(rows, len(sensor.bounds.low), device=device)

    def __call__(self, inputs: SensorInput) -> Tensor:
        due = inputs.due(self._period)
        self._state.masked_fill_((due & (inputs.steps == 0).squeeze(-1))[:, None], 0.0)
        read = {key: inputs.observation[key] for key in READ if key in inputs.observation}
        tracks = self._tracker.follow(self._state, read, due)
        self._values = self._values.clone()
        movers = self._values[:, :TRACKED].unflatten(-1, (COUNT, NUMBERS))
        scans = self._values[:, TRACKED:].unflatten(-1, (len(INSTANTS), BEARINGS))
        put_in_order(movers, due, *tracks[:4], read["pose"][:, :2], read["imu"][:, 2:])
        predict_scans(scans, due, movers)
        return self._values


def put_in_order(
    found: Tensor,
    rows: Tensor,
    position: Tensor,
    velocity: Tensor,
    radius: Tensor,
    exists: Tensor,
    place: Tensor,
    yaw: Tensor,
) -> None:
    """Writes the movers that come nearest in the next two seconds, the nearest first.

    Args:
        found: where their numbers are written, in the frame of each rover, ``[N, count, NUMBERS]`` for a count of at
            most 12; 0 where there are fewer.
        rows: rows that are written, bool ``[N]``.
        position, velocity: positions (m) and velocities (m/s) of movers in the world, ``[N, M, 2]``.
        radius, exists: radii (m), and which movers there are, ``[N, M]``.
        place, yaw: places (m) and headings (rad) of the rovers, ``[N, 2]`` and ``[N, 1]``.
    """
    # Importing NVIDIA Warp takes half a second.
    from rover_rl.envs.sensors.movers_kernels import put_in_order
    from rover_rl.native.warp import launch_rows, wp

    heading = torch.cat((yaw.cos(), yaw.sin()), -1)
    vectors = (wp.from_torch(part, dtype=wp.vec2) for part in (position, velocity, place, heading))
    inputs = [*vectors, *map(wp.from_torch, (radius, exists, rows, found))]
    launch_rows(put_in_order, found.shape[:1], inputs, found.device)


def predict_scans(scans: Tensor, rows: Tensor, movers: Tensor) -> None:
    """Writes the ranges of movers ``[N, COUNT, NUMBERS]`` at later instants, ``[N, instants, bearings]``, m.

    The rays start where the rover is now, and are as wide as the angle between them, so that no mover is missed.
    ``rows`` are those that are written, bool ``[N]``.
    """
    from rover_rl.envs.sensors.movers_kernels import predict_scans
    from rover_rl.native.warp import launch_rows, wp

    inputs = [*_rays(scans.device), math.tan(math.pi / BEARINGS), FARTHEST, *map(wp.from_torch, (movers, rows, scans))]
    launch_rows(predict_scans, scans.shape[:1], inputs, scans.device)


@cache
def _rays(device: torch.device) -> tuple[Any, Any]:
    """Directions of the rays of predicted scans, and the instants of these, as arrays of Warp."""
    from rover_rl.native.warp import wp

    angles = torch.arange(BEARINGS, device=device) * (2 * math.pi / BEARINGS)
    rays = torch.stack((angles.cos(), angles.sin()), -1)
    return wp.from_torch(rays, dtype=wp.vec2), wp.from_torch(torch.tensor(INSTANTS, device=device))


def encoded(movers: Tensor) -> Tensor:
    """Encodes movers ``[..., NUMBERS]`` as whether there is one, where, how near, how fast and how wide, about 1."""
    place, velocity, radius = movers.split((2, 2, 1), -1)
    exists, distance = (radius > 0).to(movers.dtype), place.norm(dim=-1, keepdim=True)
    near = (1 - distance / 6).clamp(min=0)
    return torch.cat((exists, place / (1 + distance), exists * near, velocity / 2, 2 * radius), -1)


def movers_of(value: Tensor) -> Tensor:
    return value[..., :TRACKED].unflatten(-1, (COUNT, NUMBERS))


def movers_in_world(value: Tensor, pose: Tensor, imu: Tensor) -> Tensor:
    """Returns the movers of values ``[N, 156]`` in the frame of the pose, ``[N, COUNT, NUMBERS]``."""
    place, velocity, radius = movers_of(value).split((2, 2, 1), -1)
    return torch.cat((pose[:, None, :2] + in_world(place, imu), in_world(velocity, imu), radius), -1)


def belong_to_movers(x: Tensor, y: Tensor, movers: Tensor) -> Tensor:
    """Returns which points belong to movers, bool ``[N, P]``.

    Args:
        x, y: points in the base frame, ``[N, P]`` each, m.
        movers: values of the sensor, ``[N, 156]``.
    """
    place, _, radius = movers_of(movers).split((2, 2, 1), -1)
    reach = torch.where(radius > 0, radius + SLACK, -1.0)[..., 0]
    dx, dy = x[..., None] - place[:, None, :, 0], y[..., None] - place[:, None, :, 1]
    return (dx * dx + dy * dy - (reach * reach.abs())[:, None]).amin(-1) < 0
