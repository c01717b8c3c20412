"""Shortest paths, distance fields, and narrow passages, where only the footprint of the robot fits."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from rover_rl import Terrain, World, box
from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space
from rover_rl.sims.free_space.cells import cells_of
from rover_rl.sims.free_space.goal_fields import SAME_GOAL, GoalFields
from rover_rl.sims.free_space.paths import CAUTION_DISTANCE, PathDistances, PathGrid, shortest_paths
from rover_rl.worlds import get_world

ROVER = get_robot("rover_zero")
POCKET = World(
    "pocket",
    Terrain.flat((12, 12)),
    [box((1.5, 0, 0.5), (0.4, 5, 1)), box((0, 2.3, 0.5), (3, 0.4, 1)), box((0, -2.3, 0.5), (3, 0.4, 1))],
)
"""World with a pocket that is open on the left."""


def test_caution_increases_only_the_cost_of_paths_along_walls() -> None:
    goal = torch.tensor([[-5.0, -5.0]])
    plain, careful = (PathGrid(POCKET, ROVER, value).costs(goal)[0] for value in (0.0, 4.0))
    ratio = (careful / plain)[free_space(POCKET, ROVER).passable & (plain > CAUTION_DISTANCE)]
    assert ratio.min() >= 1 - 1e-5
    assert ratio.max() <= 5
    assert (careful > plain + 0.1).any()
    with pytest.raises(ValueError, match="caution must be at least 0 and at most 15, got 16"):
        PathGrid(POCKET, ROVER, 16)


def test_caution_avoids_slopes() -> None:
    """Paths over a hill with slopes of up to 20 degrees, and past it."""
    x = torch.arange(-5, 5.1, 0.1, dtype=torch.float64)
    y, x = torch.meshgrid(x, x, indexing="ij")
    hill = World("hill", Terrain(0.9 * torch.exp(-(x**2 + y**2) / (2 * 1.5**2)), 0.1))
    grids = [PathGrid(hill, ROVER, caution) for caution in (0.0, 4.0)]
    for x_start, least, most in ((-4, -1e-3, 0.02), (0, 0.5, 2.5)):
        plain, careful = (grid.costs(torch.tensor([[x_start, -4.0]]))[0] for grid in grids)
        # From y = 4 to y = -4.
        assert least < (careful - plain)[90, 50 + 10 * x_start] < most


def test_a_path_around_a_wall_is_as_long_as_a_string_around_its_corners() -> None:
    start, goal = torch.tensor([[0.5, 0.0], [-5.0, 0.0]]), torch.tensor([[5.0, 0.0], [-5.0, 0.3]])
    length, near = shortest_paths(POCKET, ROVER, start, goal, goal_radius=0.5).tolist()
    # Out of the pocket, whose walls are 3 m long, and around it, a robot's radius away from them.
    r = ROVER.radius
    corners = [(0.5, 0.0), (-1.5 - r, 2.1), (-1.5 - r, 2.5 + r), (1.7 + r, 2.5 + r), (5.0, 0.0)]
    assert near == 0
    assert length == pytest.approx(sum(math.dist(a, b) for a, b in pairwise(corners)) - 0.5, rel=0.06)
    way = PathGrid(POCKET, ROVER).path(start[0], goal[0])
    assert way[[0, -1]].tolist() == [[0.5, 0.0], [5.0, 0.0]]
    assert free_space(POCKET, ROVER).contains(way).all()


def with_gap(width: float, offset: float = 0.0, yaw: float = 0.0) -> World:
    """Creates a wall with a gap between a start on its left and a goal on its right."""
    halves = []
    for along in (-width / 2 - 4, width / 2 + 4):
        center = (-math.sin(yaw) * along, math.cos(yaw) * along + offset, 0.5)
        halves.append(box(center, (0.2, 8.0, 1.0), yaw=yaw))
    areas = {"spawn_range": ((-4.5, -2.5), (-1, 1)), "goal_range": ((2.5, 4.5), (-1, 1))}
    return World("gap", Terrain.flat((10, 10)), halves, **areas)


@pytest.mark.parametrize(("offset", "degrees"), [(0.0, 0), (0.05, 0), (0.08, 10), (0.02, 30)])
def test_gaps_of_70_cm_are_passable(offset, degrees):
    world, start, goal = with_gap(0.7, offset, math.radians(degrees)), [[-3.5, 0.0]], [[3.5, 0.0]]
    free = free_space(world, ROVER)
    assert len(free.narrow_orientations) > 0
    costs = PathGrid(world, ROVER).costs(torch.tensor(goal))[0]
    assert 6.9 < costs[cells_of(free, torch.tensor(start))].item() < 7.7
    assert 6.4 < shortest_paths(world, ROVER, torch.tensor(start), torch.tensor(goal)).item() < 7.2


def test_gaps_below_the_width_of_the_rover_are_closed():
    with pytest.raises(ValueError, match="has no free spawn cell"):
        free_space(with_gap(0.45), ROVER)


def test_nothing_is_narrow_where_roomy_cells_connect_everything():
    for world in (with_gap(1.0), get_world("maze")):
        free = free_space(world, ROVER)
        assert len(free.narrow_orientations) == 0
        assert torch.equal(free.passable, free.roomy)


def test_the_footprint_is_free_in_all_orientations_of_narrow_cells():
    world = get_world("forest:3")
    free, outline = free_space(world, ROVER), ROVER.footprint
    # Every fifth pose.
    cell, k = (part[::5] for part in np.nonzero((free.narrow_orientations.numpy()[:, None] >> np.arange(32)) & 1))
    places = (free.passable & ~free.roomy).nonzero().numpy()[cell, ::-1] * free.cell + free.origin
    assert len(places) > 500
    for side in (-1, 1):
        # At both ends of the bin.
        yaw = (2 * k + side) * math.pi / 64
        nearest = np.full(len(places), np.inf)
        for obstacle in world.obstacles:
            corners = obstacle.footprint.numpy()
            radius = np.linalg.norm(corners - corners.mean(0), axis=1).max()
            x, y = (corners.mean(0) - places).T
            turned = np.stack((np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x), -1)
            # The distance of the circle around the solid from the rectangle. Prisms are up to 6 mm smaller.
            beside = np.maximum(np.abs(turned) - (outline.half_length, outline.half_width), 0)
            nearest = np.minimum(nearest, np.linalg.norm(beside, axis=1) - radius)
        # The margin is no larger than needed.
        assert 0.0 < nearest.min() < 0.05


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


# Fields of the goals of a batch


WALL = World("wall", Terrain.flat((9, 7)), [box((0, 0, 0.5), (0.4, 4, 1))])
WORLDS = [get_world("maze:1"), WALL, get_world("moon")]


def some(cells: str, count: int) -> tuple[Tensor, Tensor]:
    """Worlds of rows, and a cell in each."""
    world = torch.arange(count) % len(WORLDS)
    found = [getattr(free_space(WORLDS[index], ROVER), cells) for index in world.tolist()]
    numbers = [(997 * row + len(cells) ** 4) % len(values) for row, values in enumerate(found)]
    return world, torch.stack([values[number] for values, number in zip(found, numbers, strict=True)]).float()


def test_lengths_are_those_of_the_shortest_paths() -> None:
    (world, goal), (_, position) = some("goal_cells", 60), some("spawn_cells", 60)
    fields = GoalFields(WORLDS, ROVER)
    fields.aim(world, goal)
    exact = PathDistances(WORLDS, ROVER)(world[:, None], position, goal)[:, 0]
    length, has_path = fields.along(position)
    error = length - exact
    assert has_path.all()
    assert error.abs().mean() < 0.08 * exact.mean()
    assert (error.abs() < 0.2 * exact + 0.6).all()
    # Several positions of a row at once are each of them.
    pair, _ = fields.along(torch.stack((position, goal), 1))
    assert torch.equal(pair[:, 0], length)
    assert (pair[:, 1] < 0.3).all()


def test_the_field_stays_until_the_goal_is_another() -> None:
    (world, goal), (_, position) = some("goal_cells", 6), some("spawn_cells", 6)
    fields = GoalFields(WORLDS, ROVER)
    fields.aim(world, goal)
    before = fields.along(position)[0]
    fields.aim(world, goal + 0.6 * SAME_GOAL)
    assert torch.equal(fields.along(position)[0], before)
    goal[3] = some("goal_cells", 40)[1][36]
    fields.aim(world, goal)
    after = fields.along(position)[0]
    assert after[3] != before[3]
    assert torch.equal(after[:3], before[:3])


def test_a_row_is_the_same_in_any_company() -> None:
    (world, goal), (_, position) = some("goal_cells", 9), some("spawn_cells", 9)
    together = GoalFields(WORLDS, ROVER)
    together.aim(world, goal)
    for row in range(9):
        alone = GoalFields(WORLDS, ROVER)
        alone.aim(world[[row]], goal[[row]])
        assert torch.equal(alone.along(position[[row]])[0], together.along(position)[0][[row]])


def test_no_path_leads_through_walls_and_beyond_the_world() -> None:
    fields = GoalFields([WALL], ROVER)
    fields.aim(torch.tensor([0]), torch.tensor([[2.0, 0.0]]))
    points = torch.tensor([[[-2.0, 0.0], [0.0, 0.0], [0.0, 2.8], [2.0, 0.0], [20.0, 0.0]]])
    length, has_path = fields.along(points)
    assert has_path.tolist() == [[True, False, True, True, False]]
    assert length[0, 0] > length[0, 2] > length[0, 3]
