"""Free space, checked with independent methods, and what is kept of it on disk; rovers at rest on the ground."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import label

from rover_rl.robots import get_robot
from rover_rl.sims.free_space import FreeSpace, free_space, rest_on_ground, space
from rover_rl.sims.free_space.cells import cells_of
from rover_rl.sims.free_space.draw import draw_world
from rover_rl.sims.free_space.ground import CLEARANCE
from rover_rl.worlds import Terrain, World, box, get_world
from rover_rl.worlds.region import overlap

ROVER = get_robot("rover_zero")
BINS = torch.arange(space.HEADINGS)
YAWS = -math.pi + 2 * math.pi * (BINS + 0.5) / space.HEADINGS


def distances(world: World, xy: np.ndarray) -> np.ndarray:
    """Returns the distance (m) of points ``[N, 2]`` to the nearest footprint: of outlines, by dense samples, or 0."""
    nearest = np.full(len(xy), np.inf)
    for obstacle in world.obstacles:
        outline = obstacle.footprint.numpy()
        edges = np.roll(outline, -1, 0) - outline
        close = (np.abs(xy - outline.mean(0)) < np.ptp(outline, 0) / 2 + 1.5).all(1)
        samples = (outline + np.linspace(0, 1, 400)[:, None, None] * edges).reshape(-1, 2)
        gaps = np.linalg.norm(xy[close, None] - samples, axis=-1).min(1)
        arms = xy[close, None] - outline
        sides = edges[:, 0] * arms[..., 1] - edges[:, 1] * arms[..., 0]
        inside = (sides > 0).all(1) | (sides < 0).all(1)
        nearest[close] = np.minimum(nearest[close], np.where(inside, 0.0, gaps))
    return nearest


def sample(cells: torch.Tensor, cell: float, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Samples positions as an episode does. Returns the positions and the indices of their cells."""
    index = rng.integers(len(cells), size=count)
    return cells.numpy()[index] + rng.uniform(-cell / 2, cell / 2, (count, 2)), index


def allowed(headings: torch.Tensor) -> torch.Tensor:
    """Whether each heading bin is allowed in each cell, bool ``[S, 64]``, from bit masks ``[S]``."""
    return ((headings[:, None] >> BINS) & 1).bool()


def lidar_poses(world: World, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Samples spawn poses. Returns the position ``[N, 3]`` and rotation ``[N, 3, 3]`` of the lidars."""
    free, rng = free_space(world, ROVER), np.random.default_rng(2)
    xy, index = sample(free.spawn_cells, free.cell, count, rng)
    bins = [rng.choice(np.flatnonzero(row)) for row in allowed(free.spawn_headings[index]).numpy()]
    yaw = -math.pi + 2 * math.pi * (np.array(bins) + rng.random(count)) / space.HEADINGS
    position, rotation = rest_on_ground(world, ROVER, torch.from_numpy(np.column_stack((xy, yaw))))
    return position + rotation @ torch.tensor(ROVER.lidar_position, dtype=torch.float64), rotation


@pytest.mark.parametrize("name", ["moon", "maze"])
def test_starts_and_goals_are_free_connected_and_a_meter_apart(name):
    world = get_world(name)
    free = free_space(world, ROVER)
    parts, _ = label(free.passable.numpy())
    goal_parts, spawn_parts = (parts[cells_of(free, cells)] for cells in (free.goal_cells, free.spawn_cells))
    assert goal_parts.min() > 0
    assert {*goal_parts, *spawn_parts} == {goal_parts[0]}
    assert allowed(free.spawn_headings).any(1).all()
    assert {*map(tuple, free.goal_extremes.tolist())} <= {*map(tuple, free.goal_cells.tolist())}
    assert torch.cdist(torch.cat((free.spawn_cells, free.goal_cells)), free.goal_extremes).amax(1).min() >= 1.0
    for kind in ("spawn", "goal"):
        xy, _ = sample(getattr(free, f"{kind}_cells"), free.cell, 300, np.random.default_rng(0))
        low, high = np.array(getattr(world, f"{kind}_range")).T
        assert ((xy >= low - 1e-5) & (xy <= high + 1e-5)).all()
        assert distances(world, xy).min() >= ROVER.radius - 1e-3
        assert free.contains(torch.from_numpy(xy)).all()


def test_passable_cells_are_within_the_bounds_and_not_on_steep_ground():
    world = get_world("moon")
    free = free_space(world, ROVER)
    centers = free.passable.nonzero().flip(1).double() * free.cell + torch.tensor(free.origin, dtype=torch.float64)
    low, high = torch.tensor(overlap(world.bounds, world.terrain.extent), dtype=torch.float64).T
    assert (centers.amin(0) - free.cell / 2 >= low + ROVER.radius - 1e-5).all()
    assert (centers.amax(0) + free.cell / 2 <= high - ROVER.radius + 1e-5).all()
    nudged = centers + torch.from_numpy(np.random.default_rng(0).uniform(-1e-4, 1e-4, centers.shape))
    assert world.terrain.normal_at(nudged)[:, 2].min() >= math.cos(math.radians(25)) - 1e-9


@pytest.mark.parametrize("name", ["inspect", "moon", "maze"])
def test_spawn_poses_are_upright_with_a_clear_lidar(name):
    world = get_world(name)
    lidar, rotation = lidar_poses(world, 300)
    assert rotation[:, 2, 2].min() >= math.cos(math.radians(21))
    assert distances(world, lidar[:, :2].numpy()).min() >= 0.4
    angle = torch.arange(128, dtype=torch.float64) * 2 * math.pi / 128
    beams = rotation[:, None, :, 0] * angle.cos()[:, None] + rotation[:, None, :, 1] * angle.sin()[:, None]
    for reach in torch.linspace(0.02, 0.4, 10, dtype=torch.float64):
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
    assert torch.cat((free.spawn_cells, free.goal_cells)).abs().amax(1).min() > 1.5


def test_spawn_headings_next_to_a_wall_do_not_face_it():
    free = free_space(World("wall", Terrain.flat((10, 10)), [box((0, 0, 0.5), (0.4, 6, 1))]), ROVER)
    cell = (free.spawn_cells - torch.tensor([0.65, 0.05])).norm(dim=1).argmin()
    yaw = YAWS[allowed(free.spawn_headings[cell : cell + 1])[0]]
    assert (yaw.cos() > -0.2).all()
    assert (yaw.cos() > 0.9).any()


def valley(width: float) -> World:
    """A valley with level ground of a width, between slopes of 27 degrees."""
    y = torch.arange(-4, 4.1, 0.1, dtype=torch.float64)
    heights = math.tan(math.radians(27)) * (y.abs() - width / 2).clamp(min=0)
    return World("valley", Terrain(heights[:, None].expand(-1, len(y)), 0.1))


def test_strips_between_steep_ground_have_a_minimum_width():
    assert 4 <= free_space(valley(0.8), ROVER).passable.any(1).sum() <= 8
    with pytest.raises(ValueError, match="no free goal cell"):
        free_space(valley(0.3), ROVER)


def cliff(height: float) -> World:
    """A cliff that rises by a height from x = 0.9 to 1.0."""
    heights = np.zeros((101, 101))
    heights[:, 60:] = height
    return World("cliff", Terrain(heights, 0.1), spawn_range=((-4, 0.9), (-4, 4)), goal_range=((-4, 0.9), (-4, 4)))


def test_neither_a_part_of_a_rover_nor_its_lidar_is_at_a_cliff():
    free = free_space(cliff(-2.0), ROVER)
    x = free.passable.nonzero()[:, 1] * free.cell + free.origin[0]
    left = x[x < 0.9]
    assert len(left) > 1000
    assert left.max() + free.cell / 2 <= 0.9 - ROVER.radius + 0.08
    assert lidar_poses(cliff(2.0), 300)[0][:, 0].max() < 0.9 - 0.4


NO_SPACE = [
    ({"obstacles": [box((0, 0, 0.5), (20, 20, 1))]}, "world 'plain' has no free goal cell for 'rover_zero'"),
    (
        {"obstacles": [box((-3, 0, 0.5), (2, 8, 1))], "spawn_range": ((-3, -2.5), (0, 1))},
        "world 'plain' has no free spawn cell for 'rover_zero', which needs a free disc of 0.35 m, in spawn_range",
    ),
    ({"goal_range": ((0, 0.5), (0, 0.5))}, "goal cells of world 'plain' lie so close together"),
]


@pytest.mark.parametrize(("changes", "message"), NO_SPACE)
def test_worlds_without_free_space_raise(changes, message):
    world = World("plain", Terrain.flat((10, 10)), **{"goal_range": ((0, 3), (-3, 3)), **changes})
    with pytest.raises(ValueError, match=message):
        free_space(world, ROVER)


def yard(side: float = 1.0) -> World:
    """A new world object with the same content for the same argument."""
    return World("yard", Terrain.flat((8, 8)), [box((0, 1, 0.5), (side, 1, 1)), box((2, -1, 0.5), (1, 1, 1))])


def test_free_space_is_kept_on_disk_for_each_world_and_robot_and_damaged_files_are_replaced(own_cache, monkeypatch):
    first = free_space(yard(), ROVER)
    (file,) = (own_cache / "free_space").rglob("*.npz")

    def assert_is_first(other: FreeSpace) -> None:
        for name, value in vars(first).items():
            torch.testing.assert_close(value, getattr(other, name), rtol=0, atol=0)

    for damaged in (b"damaged", file.read_bytes()[:-100]):
        file.write_bytes(damaged)
        assert_is_first(free_space(yard(), ROVER))
    with monkeypatch.context() as patch:
        patch.setattr(space, "_compute", None)
        assert_is_first(free_space(yard(), replace(ROVER, name="twin")))
    free_space(yard(1.1), ROVER)
    free_space(yard(), replace(ROVER, radius=0.4))
    assert len([*file.parents[1].rglob("*.npz")]) == 3


def test_a_cache_that_cannot_be_written_is_no_error(own_cache):
    own_cache.write_text("a file where the folder would be")
    assert isinstance(free_space(yard(), ROVER), FreeSpace)


@settings(max_examples=25)
@given(slopes=st.tuples(*[st.floats(-0.5, 0.5)] * 2), pose=st.tuples(*[st.floats(-3, 3)] * 3))
def test_on_a_ramp_the_rover_is_aligned_with_the_plane(slopes, pose):
    (slope_x, slope_y), (x, y, yaw) = slopes, pose
    rows, columns = np.meshgrid(np.linspace(-10, 10, 41), np.linspace(-10, 10, 41), indexing="ij")
    ramp = World("ramp", Terrain(slope_x * columns + slope_y * rows + 3.0, 0.5))
    position, rotation = rest_on_ground(ramp, ROVER, torch.tensor([[x, y, yaw]], dtype=torch.float64))
    up = np.array([-slope_x, -slope_y, 1.0]) / math.hypot(slope_x, slope_y, 1.0)
    ahead = np.array([math.cos(yaw), math.sin(yaw), slope_x * math.cos(yaw) + slope_y * math.sin(yaw)])
    assert rotation[0, :, 2].numpy() == pytest.approx(up, abs=1e-5)
    assert rotation[0, :, 0].numpy() == pytest.approx(ahead / np.linalg.norm(ahead), abs=1e-5)
    assert (rotation[0] @ rotation[0].T).numpy() == pytest.approx(np.eye(3), abs=1e-9)
    # Measured along the vertical, the lowest wheel is CLEARANCE above the ground.
    hub_gap = (ROVER.wheels.radius - ROVER.wheels.hubs[0][2]) / up[2]
    height = 3.0 + slope_x * x + slope_y * y + CLEARANCE + hub_gap
    assert position[0].tolist() == pytest.approx([x, y, height], abs=1e-5)


def test_on_rough_ground_the_lowest_wheel_touches_the_ground_whatever_the_batch():
    world, rng = get_world("moon"), np.random.default_rng(0)
    low, high = np.array(world.spawn_range).T
    poses = torch.from_numpy(np.column_stack((rng.uniform(low, high, (200, 2)), rng.uniform(-math.pi, math.pi, 200))))
    position, rotation = rest_on_ground(world, ROVER, poses)
    angle = torch.linspace(0, 2 * math.pi, 181, dtype=torch.float64)
    across = torch.linspace(-ROVER.wheels.width / 2, ROVER.wheels.width / 2, 9, dtype=torch.float64)
    a, w = torch.meshgrid(angle, across, indexing="ij")
    tread = torch.stack((ROVER.wheels.radius * a.cos(), w, ROVER.wheels.radius * a.sin()), -1).reshape(-1, 3)
    body = (torch.tensor(ROVER.wheels.hubs, dtype=torch.float64)[:, None] + tread).reshape(-1, 3)
    points = position[:, None] + body @ rotation.transpose(1, 2)
    assert (points[..., 2] - world.height_at(points[..., :2])).amin(1).abs().max() < 2e-3
    for row in (0, 17, 63):
        alone = rest_on_ground(world, ROVER, poses[row : row + 1])
        assert torch.equal(alone[0][0], position[row])
        assert torch.equal(alone[1][0], rotation[row])


@pytest.mark.parametrize("name", ["hills", "maze"])
def test_a_map_shows_the_free_space_and_elevation_where_there_is_some(name, tmp_path):
    path = tmp_path / "map.png"
    figure = draw_world(get_world(name), ROVER, path)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert name in figure.axes[0].get_title()
    labels = {text.get_text().split(" (")[0] for text in figure.axes[0].get_legend().get_texts()}
    assert labels >= {"free: starts, goals", "free, but out of reach", "obstacle", "start area", "goal area", "bounds"}
    assert [other.get_ylabel() for other in figure.axes[1:]] == ([] if name == "maze" else ["elevation (m)"])
