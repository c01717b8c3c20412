"""Contacts of the rover's outline with the obstacles of a world, computed from poses."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from rover_rl.robots import Robot
from rover_rl.robots.footprint import footprint
from rover_rl.rotations import euler_to_matrix
from rover_rl.worlds import World
from rover_rl.worlds.obstacles import Obstacle, groups_of

TOUCH = 0.01  # largest distance between the body and an obstacle that counts as a contact, m
_OUTLINE_SPACING = 0.02  # largest distance between neighboring points of the rover's outline, m
_CHUNK = 4096  # Number of poses that are tested against an obstacle at once. Limits the memory to about 100 MB.


def is_touching(position: Tensor, angles: Tensor, world: World, robot: Robot) -> Tensor:
    """Returns whether the rover's body touches an obstacle in each of several poses, bool ``[P]``.

    The body touches an obstacle if its footprint (:func:`rover_rl.robots.footprint.footprint`), at the height of
    the wheel hubs, is within 1 cm of it. Obstacles below the wheel hubs count as ground.

    Args:
        position: positions of the rover, ``[P, 3]``, m.
        angles: roll, pitch and yaw of the rover, ``[P, 3]``, rad.
        world: world with the obstacles.
        robot: robot that determines the footprint.
    """
    outline = _outline(robot)
    reach = outline[:, :2].norm(dim=1).max().item() + TOUCH
    touched = torch.zeros(len(position), dtype=torch.bool)
    for obstacle in _obstacles_within(reach, position[:, :2], world):
        normals, offsets = obstacle.planes.to(position).split((3, 1), -1)
        near = _near(position[:, :2], obstacle, reach) & ~touched
        for poses in near.nonzero().squeeze(-1).split(_CHUNK):
            points = position[poses, None] + outline @ euler_to_matrix(angles[poses]).mT
            touched[poses] = ((points @ normals.T + offsets.T).amax(-1) <= TOUCH).any(-1)
    return touched


def _obstacles_within(reach: float, path: Tensor, world: World) -> list[Obstacle]:
    """Returns the obstacles whose bounding circle, seen from above, is within ``reach`` (m) of ``path [P, 2]``."""
    if not world.obstacles:
        return []
    centers, radii = _circles(world)
    nearest = torch.stack([torch.cdist(part, centers).amin(0) for part in path.double().split(_CHUNK)]).amin(0)
    # The margin covers rounding. Obstacles that are not near are sorted out later.
    near = (nearest <= radii + reach + 1e-3).nonzero().squeeze(-1)
    return [world.obstacles[index] for index in near.tolist()]


@lru_cache(maxsize=64)
def _circles(world: World) -> tuple[Tensor, Tensor]:
    """Centers ``[N, 2]`` and radii ``[N]`` of the obstacles' bounding circles, seen from above, float64, m."""
    outlines = [torch.from_numpy(solids.outlines) for solids in groups_of(world.obstacles)]
    centers = [group.mean(1) for group in outlines]
    radii = [(g - c[:, None]).norm(dim=-1).amax(1) for g, c in zip(outlines, centers, strict=True)]
    return torch.cat(centers), torch.cat(radii)


def _near(path: Tensor, obstacle: Obstacle, reach: float) -> Tensor:
    """Whether each point of ``path [P, 2]`` is within ``reach`` (m) of the obstacle seen from above, bool ``[P]``."""
    outline = obstacle.footprint.to(path)
    near = ((path >= outline.amin(0) - reach) & (path <= outline.amax(0) + reach)).all(-1)
    near[near.clone()] = _distance_to_polygon(path[near], outline) <= reach
    return near


def _outline(robot: Robot) -> Tensor:
    """Points on the footprint at the height of the wheel hubs, in the base frame, ``[P, 3]``, m."""
    back, front, right, left = footprint(robot)
    height = sum(hub[2] for hub in robot.wheels.hubs) / len(robot.wheels.hubs)
    x, y = (torch.linspace(a, b, math.ceil((b - a) / _OUTLINE_SPACING) + 1) for a, b in ((back, front), (right, left)))
    sides = torch.cartesian_prod(x, torch.tensor((right, left)))
    ends = torch.cartesian_prod(torch.tensor((back, front)), y)
    return torch.nn.functional.pad(torch.cat((sides, ends)), (0, 1), value=height)


def _distance_to_polygon(points: Tensor, polygon: Tensor) -> Tensor:
    """Distance from ``points [..., 2]`` to a convex polygon, counter-clockwise ``[K, 2]``, 0 inside it."""
    edges = polygon.roll(-1, 0) - polygon
    offsets = points[..., None, :] - polygon
    along = ((offsets * edges).sum(-1) / (edges**2).sum(-1)).clamp(0, 1)
    distance = (offsets - along[..., None] * edges).norm(dim=-1).amin(-1)
    inside = (edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0] >= 0).all(-1)
    return distance.masked_fill(inside, 0.0)
