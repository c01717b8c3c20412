"""Moving walls: long things that move broadside around the rover, as tracked in its lidar scans."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from rover_rl.envs.sensors.base import Rig, RigSensor, SensorInput, mirrored_signs
from rover_rl.envs.sensors.seen_tracks import SeenTracks, reader_of
from rover_rl.envs.sensors.suite import WALLS
from rover_rl.envs.specs import Bounds
from rover_rl.envs.wall_tracker import STATE, TRACKS, Walls, WallTracker, walls_in_base_frame

COUNT = 4
"""Number of walls in the entry."""
NUMBERS = 7
"""Numbers of a wall: x, y, cosine and sine of its direction, half of its length, and velocity along x and y."""
SLACK = 0.25
"""Distance from a wall up to which readings belong to it, m."""


class SeenWalls(SeenTracks):
    """Long things that move around the rovers of a batch, from scan to scan: see :class:`MovingWalls`."""

    tracker = WallTracker
    remembered = TRACKS * STATE
    told = COUNT * NUMBERS

    def values(self, tracks: Walls, observation: Mapping[str, Tensor]) -> Tensor:
        """Returns the values of the sensor, ``[N, 28]``."""
        walls = walls_in_base_frame(tracks, observation)
        # Of the two directions along a wall, the one that is ahead.
        along = torch.where(walls.along[..., :1] < 0, -walls.along, walls.along)
        every = torch.cat((walls.position, along, walls.half[..., None], walls.velocity), -1) * walls.moves[..., None]
        gap = _gaps(torch.zeros_like(every[..., :1, :2]), every).squeeze(-2).masked_fill(~walls.moves, math.inf)
        order = gap.sort(dim=-1, stable=True).indices[:, :COUNT]
        return every.gather(1, order[..., None].expand(-1, -1, NUMBERS)).flatten(1)


@dataclass(frozen=True, kw_only=True)
class MovingWalls(RigSensor):
    """Up to 4 long things around the rover that move broadside: walls, gates, sides of trucks, ``[N, 28]``.

    Each has x and y of the middle of what has been seen of it in the base frame (m), cosine and sine of the direction
    along it relative to the heading (the one ahead, so that the cosine is not negative), half of its length (m), which
    is 0 where there is none, and its velocity over ground along x and y (m/s), which is along its normal. The nearest
    is the first. They are tracked in the lidar scans (see :class:`~rover_rl.envs.wall_tracker.WallTracker`). The map of
    what has been seen leaves them out if the observation has this entry.

    Args:
        name: key of the entry.
        period: number of steps from one scan that is used to the next.

    Example:
        >>> env = RoverEnv(world_n="gates", num_envs=2, seed=0, sensors=["walls"])
        >>> env.rollout(5)["walls"].unflatten(-1, (4, 7)).shape
        torch.Size([2, 5, 4, 7])
    """

    name: str = WALLS
    clips = False
    delayed = None
    takes_long = True
    bounds = Bounds(
        (-30.0, -30.0, 0.0, -1.0, 0.0, -20.0, -20.0) * COUNT, (30.0, 30.0, 1.0, 1.0, 30.0, 20.0, 20.0) * COUNT
    )

    def reader(self, rig: Rig) -> Callable[[SensorInput], Tensor]:
        """Returns a reader with tracks of its own."""
        return reader_of(SeenWalls, self, rig)

    def encode(self, value: Tensor) -> Tensor:
        """Returns for each wall whether there is one, and its place, distance, direction, length and velocity.

        The direction is told by cosine and sine of twice its angle, as both directions along a wall are the same.
        """
        walls = walls_of(value)
        place, along, half, velocity = walls.split((2, 2, 1, 2), -1)
        exists = (half > 0).to(walls.dtype)
        near = (1 - _gaps(torch.zeros_like(place[..., :1, :]), walls).squeeze(-2)[..., None] / 6).clamp(min=0)
        cos, sin = along.split(1, -1)
        twice = torch.cat((cos * cos - sin * sin, 2 * cos * sin), -1)
        distance = place.norm(dim=-1, keepdim=True)
        return torch.cat((exists, place / (1 + distance), exists * near, twice, half / 2, velocity / 2), -1).flatten(-2)

    def mirror(self, value: Tensor) -> Tensor:
        """Mirrors the walls."""
        return mirrored_signs((1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0) * COUNT, value)


def walls_of(value: Tensor) -> Tensor:
    """Returns the walls in values of the sensor, ``[..., COUNT, NUMBERS]``."""
    return value.unflatten(-1, (COUNT, NUMBERS))


def _gaps(points: Tensor, walls: Tensor) -> Tensor:
    """Returns the distances of points ``[..., P, 2]`` from walls ``[..., W, NUMBERS]``, ``[..., P, W]``, m."""
    place, along, half, _ = walls[..., None, :, :].split((2, 2, 1, 2), -1)
    away = points[..., None, :] - place
    on = (away * along).sum(-1, keepdim=True)
    return (away - torch.minimum(torch.maximum(on, -half), half) * along).norm(dim=-1)


def belong_to_walls(x: Tensor, y: Tensor, walls: Tensor) -> Tensor:
    """Returns which points belong to walls, bool ``[N, P]``.

    Args:
        x, y: points in the base frame, ``[N, P]`` each, m.
        walls: values of the sensor, ``[N, 28]``.
    """
    walls = walls_of(walls)
    exists = walls[:, None, :, 4] > 0
    return ((_gaps(torch.stack((x, y), -1), walls) < SLACK) & exists).any(-1)
