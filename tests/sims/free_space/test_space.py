"""Free space, checked with independent methods."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import label

from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space, rest_on_ground
from rover_rl.sims.free_space.cells import CellGrid, cells_of
from rover_rl.sims.free_space.ground import level_cells, rest_headings
from rover_rl.sims.free_space.passages import headings_of_bins
from rover_rl.sims.free_space.space import HEADINGS
from rover_rl.worlds import Terrain, World, box, get_world
from rover_rl.worlds.region import overlap

ROVER = get_robot("rover_zero")
NAMES = ["inspect", "moon", "maze"]


def distances(world: World, xy: np.ndarray) -> np.ndarray:
    """Returns the distance (m) of points ``[N, 2]`` to the nearest footprint, from dense samples of the outlines."""
    nearest = np.full(len(xy), np.inf)
    for obstacle in world.obstacles:
        outline = obstacle.footprint.numpy()
        ends = np.roll(outline, -1, 0)
        share = np.linspace(0, 1, 400)[:, None, None]
        samples = (outline + share * (ends - outline)).reshape(-1, 2)
        close = (np.abs(xy - outline.mean(0)) < np.ptp(outline, 0) / 2 + 1.5).all(1)
        if close.any():
            gaps = np.linalg.norm(xy[close, None] - samples, axis=-1).min(1)
            nearest[close] = np.minimum(nearest[close], gaps)
    return nearest


def in_an_outline(world: World, xy: np.ndarray) -> np.ndarray:
    """Returns which points are in a footprint, by the winding number of its outline."""
    inside = np.zeros(len(xy), dtype=bool)
    for obstacle in world.obstacles:
        outline = obstacle.footprint.numpy()
        angles = np.arctan2(*(outline[None] - xy[:, None]).transpose(2, 0, 1)[::-1])
        turns = np.diff(np.concatenate((angles, angles[:, :1]), 1), axis=1)
        turns = (turns + math.pi) % (2 * math.pi) - math.pi
        inside |= np.abs(turns.sum(1)) > 1
    return inside


def sample(cells: torch.Tensor, cell: float, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Samples positions as an episode does. Returns the positions and the indices of their cells."""
    index = rng.integers(len(cells), size=count)
    return cells.numpy()[index] + rng.uniform(-cell / 2, cell / 2, (count, 2)), index


@pytest.mark.parametrize("name", NAMES)
def test_spawn_cells_have_headings_and_goals_that_can_be_reached_and_are_a_meter_away(name):
    free = free_space(get_world(name), ROVER)
    labels, _ = label(free.passable.numpy())
    goal_labels, spawn_labels = (labels[cells_of(free, cells)] for cells in (free.goal_cells, free.spawn_cells))
    assert goal_labels.min() > 0
    assert {*goal_labels, *spawn_labels} == {goal_labels[0]}
    assert free.spawn_headings.shape == (len(free.spawn_cells),)
    assert allowed(free.spawn_headings).any(1).all()
    goals = {tuple(goal) for goal in free.goal_cells.tolist()}
    assert {tuple(extreme) for extreme in free.goal_extremes.tolist()} <= goals
    cells = torch.cat((free.spawn_cells, free.goal_cells))
    assert torch.cdist(cells, free.goal_extremes).amax(1).min() >= 1.0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", ["spawn", "goal"])
def test_sampled_positions_are_in_range_and_the_rovers_disc_is_free(name, kind):
    world = get_world(name)
    free = free_space(world, ROVER)
    xy, _ = sample(getattr(free, f"{kind}_cells"), free.cell, 400, np.random.default_rng(0))
    low, high = np.array(getattr(world, f"{kind}_range")).T
    assert (xy >= low - 1e-5).all()
    assert (xy <= high + 1e-5).all()
    assert not in_an_outline(world, xy).any()
    assert distances(world, xy).min() >= ROVER.radius - 1e-3
    assert free.contains(torch.from_numpy(xy)).all()


@pytest.mark.parametrize("name", NAMES)
def test_passable_cells_are_within_the_bounds_and_not_on_steep_ground(name):
    world = get_world(name)
    free = free_space(world, ROVER)
    centers = free.passable.nonzero().flip(1).double() * free.cell + torch.tensor(free.origin, dtype=torch.float64)
    for axis, (low, high) in enumerate(overlap(world.bounds, world.terrain.extent)):
        assert centers[:, axis].min() - free.cell / 2 >= low + ROVER.radius - 1e-5
        assert centers[:, axis].max() + free.cell / 2 <= high - ROVER.radius + 1e-5
    nudged = centers + torch.from_numpy(np.random.default_rng(0).uniform(-1e-4, 1e-4, centers.shape))
    assert world.normal_at(nudged)[:, 2].min() >= math.cos(math.radians(25)) - 1e-9


def allowed(headings: torch.Tensor) -> torch.Tensor:
    """Whether each heading bin is allowed in each cell, bool ``[S, HEADINGS]``, from bit masks ``[S]``."""
    return ((headings[:, None] >> torch.arange(HEADINGS)) & 1).bool()


def lidar_poses(world: World, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Samples spawn poses. Returns the position ``[N, 3]`` and rotation ``[N, 3, 3]`` of the lidars."""
    free = free_space(world, ROVER)
    rng = np.random.default_rng(2)
    xy, index = sample(free.spawn_cells, free.cell, count, rng)
    bins = [rng.choice(np.flatnonzero(row)) for row in allowed(free.spawn_headings[index]).numpy()]
    yaw = -math.pi + 2 * math.pi * (np.array(bins) + rng.random(count)) / HEADINGS
    position, rotation = rest_on_ground(world, ROVER, torch.from_numpy(np.column_stack((xy, yaw))))
    return position + rotation @ torch.tensor(ROVER.lidar_position, dtype=torch.float64), rotation


@pytest.mark.parametrize("name", NAMES)
def test_spawn_poses_are_upright_with_a_clear_lidar(name):
    world = get_world(name)
    lidar, rotation = lidar_poses(world, 600)
    assert rotation[:, 2, 2].min() >= math.cos(math.radians(21))
    assert not in_an_outline(world, lidar[:, :2].numpy()).any()
    assert distances(world, lidar[:, :2].numpy()).min() >= 0.4
    angle = torch.arange(128, dtype=torch.float64) * 2 * math.pi / 128
    beams = rotation[:, None, :, 0] * angle.cos()[:, None] + rotation[:, None, :, 1] * angle.sin()[:, None]
    for reach in torch.linspace(0.02, 0.4, 20, dtype=torch.float64):
        points = lidar[:, None] + reach * beams
        assert (points[..., 2] > world.height_at(points[..., :2])).all()


def test_contains_looks_up_the_cell():
    free = free_space(get_world("maze"), ROVER)
    row, column = (int(i) for i in free.passable.nonzero()[100])
    center = torch.tensor([free.origin[0] + column * free.cell, free.origin[1] + row * free.cell])
    assert free.contains(center)
    assert free.contains(center + 0.049 * torch.tensor([1.0, -1.0]))
    outside = torch.tensor([[99.0, 0.0], [0.0, -99.0], [math.nan, 0.0], [-10.01, 0.0], [math.inf, 0.0]])
    assert not free.contains(outside).any()
    assert free.contains(torch.zeros(3, 4, 2)).shape == (3, 4)


@pytest.mark.parametrize(("height", "passable"), [(2.0, True), (-2.0, True), (0.6, False)])
def test_overhead_and_buried_obstacles_are_ignored(height, passable):
    world = World("plain", Terrain.flat((10, 10)), [box((0, 0, height), (6, 6, 0.4))])
    assert free_space(world, ROVER).contains(torch.zeros(2)) == passable


def test_an_enclosed_pocket_has_no_goal_and_no_spawn_cell():
    ring = [box((0, y, 0.5), (3.4, 0.4, 1)) for y in (-1.5, 1.5)]
    ring += [box((x, 0, 0.5), (0.4, 3.4, 1)) for x in (-1.5, 1.5)]
    free = free_space(World("ring", Terrain.flat((12, 12)), ring), ROVER)
    assert free.contains(torch.zeros(2))
    for cells in (free.spawn_cells, free.goal_cells):
        assert cells.abs().amax(1).min() > 1.5


def test_spawn_headings_next_to_a_wall_do_not_face_it():
    free = free_space(World("wall", Terrain.flat((10, 10)), [box((0, 0, 0.5), (0.4, 6, 1))]), ROVER)
    cell = (free.spawn_cells - torch.tensor([0.65, 0.05])).norm(dim=1).argmin()
    bins = allowed(free.spawn_headings[cell : cell + 1])[0].nonzero()[:, 0]
    yaw = -math.pi + 2 * math.pi * (bins + 0.5) / HEADINGS
    assert (yaw.cos() > -0.2).all()
    assert (yaw.cos() > 0.9).any()


def valley(width: float) -> World:
    """A valley with level ground of a width, between slopes of 27 degrees."""
    y = torch.arange(-4, 4.1, 0.1, dtype=torch.float64)
    heights = math.tan(math.radians(27)) * (y.abs() - width / 2).clamp(min=0)
    return World("valley", Terrain(heights[:, None].expand(-1, len(y)), 0.1))


def test_strips_between_steep_ground_have_a_minimum_width():
    rows = free_space(valley(0.8), ROVER).passable.any(1)
    assert 4 <= rows.sum() <= 8
    with pytest.raises(ValueError, match="no free goal cell"):
        free_space(valley(0.3), ROVER)


def cliff(height: float) -> World:
    """A cliff that rises by a height from x = 0.9 to 1.0."""
    heights = np.zeros((101, 101))
    heights[:, 60:] = height
    return World("cliff", Terrain(heights, 0.1), spawn_range=((-4, 0.9), (-4, 4)), goal_range=((-4, 0.9), (-4, 4)))


def test_no_part_of_a_rover_is_above_a_cliff():
    free = free_space(cliff(-2.0), ROVER)
    _, column = free.passable.nonzero().unbind(1)
    x = column * free.cell + free.origin[0]
    left = x[x < 0.9]
    assert len(left) > 1000
    assert left.max() + free.cell / 2 <= 0.9 - ROVER.radius + 0.08


@pytest.mark.parametrize("name", ["hills:3", "moon:4"])
def test_level_ground_allows_all_headings(name):
    world = get_world(name)
    grid = CellGrid(world.spawn_range)
    cells = grid.centers(np.random.default_rng(0).random(grid.shape) < 0.1)
    level = level_cells(world.terrain, ROVER, grid, cells)
    headings, _ = rest_headings(world.terrain, ROVER, grid, cells, torch.from_numpy(headings_of_bins()))
    assert 0.2 < level.double().mean() < 1
    assert (headings[level] == -1).all()


def test_spawn_poses_keep_the_lidar_away_from_a_cliff():
    lidar, _ = lidar_poses(cliff(2.0), 500)
    assert lidar[:, 0].max() < 0.9 - 0.4


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"obstacles": [box((0, 0, 0.5), (20, 20, 1))]}, "world 'plain' has no free goal cell for 'rover_zero'"),
        (
            {"obstacles": [box((-3, 0, 0.5), (2, 8, 1))], "spawn_range": ((-3, -2.5), (0, 1))},
            "world 'plain' has no free spawn cell for 'rover_zero'",
        ),
        ({"goal_range": ((0, 0.5), (0, 0.5))}, "goal cells of world 'plain' lie so close together"),
        ({"bounds": ((50, 60), (50, 60)), "spawn_range": ((51, 52), (51, 52))}, "no free goal cell"),
    ],
)
def test_worlds_without_free_space_raise(settings, message):
    settings = {"goal_range": ((0, 3), (-3, 3)), **settings}
    if "bounds" in settings:
        settings["goal_range"] = settings["spawn_range"]
    world = World("plain", Terrain.flat((10, 10)), **settings)
    with pytest.raises(ValueError, match=message):
        free_space(world, ROVER)
