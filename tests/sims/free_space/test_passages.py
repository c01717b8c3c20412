"""Narrow passages: where the footprint of the robot fits, but not its turning circle."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space
from rover_rl.sims.free_space.cells import cells_of
from rover_rl.sims.free_space.paths import PathGrid, shortest_paths
from rover_rl.worlds import Terrain, World, box, get_world

ROVER = get_robot("rover_zero")


def with_gap(width: float, offset: float = 0.0, yaw: float = 0.0) -> World:
    """Creates a wall with a gap between a start on its left and a goal on its right."""
    halves = []
    for side in (-1, 1):
        along = side * (width / 2 + 4)
        center = (-math.sin(yaw) * along, math.cos(yaw) * along + offset, 0.5)
        halves.append(box(center, (0.2, 8.0, 1.0), yaw=yaw))
    return World(
        "gap", Terrain.flat((10, 10)), halves, spawn_range=((-4.5, -2.5), (-1, 1)), goal_range=((2.5, 4.5), (-1, 1))
    )


@pytest.mark.parametrize(("offset", "degrees"), [(0.0, 0), (0.05, 0), (0.08, 10), (0.02, 30)])
def test_gaps_of_70_cm_are_passable(offset, degrees):
    world = with_gap(0.7, offset, math.radians(degrees))
    free = free_space(world, ROVER)
    assert len(free.narrow_orientations) > 0
    costs = PathGrid(world, ROVER).costs(torch.tensor([[3.5, 0.0]]))[0]
    start = torch.tensor([[-3.5, 0.0]])
    assert 6.9 < costs[cells_of(free, start)].item() < 7.7
    length = shortest_paths(world, ROVER, start, torch.tensor([[3.5, 0.0]]))
    assert 6.4 < length.item() < 7.2


def test_gaps_below_the_width_of_the_rover_are_closed():
    with pytest.raises(ValueError, match="has no free spawn cell"):
        free_space(with_gap(0.45), ROVER)


def test_nothing_is_narrow_where_roomy_cells_connect_everything():
    for world in (with_gap(1.0), *map(get_world, ("maze", "rooms:4", "inspect"))):
        free = free_space(world, ROVER)
        assert len(free.narrow_orientations) == 0
        assert torch.equal(free.passable, free.roomy)


def narrow_poses(world: World) -> np.ndarray:
    """Returns x, y and yaw of all orientations of narrow cells, at the ends of their bins, ``[P, 3]``."""
    free = free_space(world, ROVER)
    row, column = (free.passable & ~free.roomy).nonzero().numpy().T
    masks = free.narrow_orientations.numpy()
    index, k = np.nonzero((masks[:, None] >> np.arange(32)) & 1)
    x, y = (start + free.cell * cells[index] for start, cells in zip(free.origin, (column, row), strict=True))
    return np.concatenate([np.stack((x, y, (2 * k + side) * math.pi / 64), -1) for side in (-1, 1)])


def test_the_footprint_is_free_in_all_orientations_of_narrow_cells():
    world = get_world("forest:3")
    poses = narrow_poses(world)
    assert len(poses) > 5000
    outline = ROVER.footprint
    half = np.array((outline.half_length, outline.half_width))
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    nearest = np.full(len(poses), np.inf)
    for obstacle in world.obstacles:
        corners = obstacle.footprint.numpy()
        middle = corners.mean(0)
        radius = np.linalg.norm(corners - middle, axis=1).max()
        offset = middle - poses[:, :2]
        inside = np.stack((cos * offset[:, 0] + sin * offset[:, 1], cos * offset[:, 1] - sin * offset[:, 0]), -1)
        # The distance of the circle around the solid from the rectangle. Prisms are up to 6 mm smaller.
        away = np.linalg.norm(np.maximum(np.abs(inside) - half, 0), axis=1) - radius
        nearest = np.minimum(nearest, away)
    assert nearest.min() > 0.0
    # The margin is no larger than needed.
    assert nearest.min() < 0.05


def test_a_world_in_which_no_cell_is_roomy_has_starts():
    # With a width of 0.8 m at y = 0.05, in which the turning circle fits only at the centers of cells.
    corridor = [box((0, 0.05 + side * 0.55, 0.5), (12, 0.3, 1)) for side in (-1, 1)]
    area = ((-5, 5), (-0.35, 0.45))
    free = free_space(World("corridor", Terrain.flat((14, 4)), corridor, area, area), ROVER)
    assert (free.spawn_cells[:, 1] - 0.05).abs().max() < 1e-6
    yaw = -math.pi + 2 * math.pi * (torch.arange(64) + 0.5) / 64
    bins = ((free.spawn_headings[:, None] >> torch.arange(64)) & 1).bool()
    assert bins.any(1).all()
    # The rover cannot be across the corridor wherever in the cell it is.
    assert yaw.sin().expand_as(bins)[bins].abs().max() < 0.9
