"""Generators: what they have in common, and their difficulty, which is measured."""

from __future__ import annotations

import hashlib
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import label

from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space
from rover_rl.sims.free_space.paths import shortest_paths
from rover_rl.worlds import WORLDS, Terrain, World, get_world, takes_scale
from rover_rl.worlds.generators import moon
from rover_rl.worlds.generators.rooms import WALL, floor_plan
from rover_rl.worlds.terrain import MAX_SLOPE

NAMES = sorted(WORLDS)
DIFFICULTIES = (0.0, 0.25, 0.5, 0.75, 1.0)
SEEDS = range(3)
DEFAULT_LAYOUTS = {
    ("maze", 0): "f6f06cadf7cce79a",
    ("maze", 10063): "2408d25cb26f037e",
    ("moon", 0): "52aaa7cc14ae750e",
    ("moon", 10063): "937f1742eb322dcd",
    ("inspect", 0): "fefc6ad423026b8f",
    ("inspect", 10063): "0ebad298d05e6410",
}
"""Digests of layouts from before generators had a difficulty."""
UNSCALED = f"{__name__}:unscaled"


def unscaled(seed: int) -> World:
    return World(f"unscaled-{seed}", Terrain.flat((10, 10)))


def digest(world) -> str:
    """Digest of heights and vertices, in units of 0.1 mm: it does not depend on the last bits of a processor."""
    digest = hashlib.sha256()
    for numbers in (world.terrain.heights.double(), *(obstacle.vertices for obstacle in world.obstacles)):
        digest.update(np.rint(numbers.numpy() * 1e4).astype("<i8").tobytes())
    digest.update(repr(world.movers).encode() if world.movers else b"")
    return digest.hexdigest()[:16]


@pytest.mark.parametrize(("name", "seed"), DEFAULT_LAYOUTS)
def test_layouts_of_the_default_difficulty_never_change(name, seed):
    assert digest(WORLDS[name](seed)) == DEFAULT_LAYOUTS[name, seed]


@pytest.mark.parametrize("name", NAMES)
def test_seed_and_difficulty_determine_a_layout(name):
    layouts = [digest(WORLDS[name](seed, level)) for seed, level in ((3, 0), (3, 0), (4, 0), (3, 0.8))]
    assert layouts[0] == layouts[1]
    assert len(set(layouts)) == 3
    assert digest(WORLDS[name](5)) == digest(WORLDS[name](seed=5, difficulty=0.5))
    for difficulty in (-0.01, 1.01, float("nan")):
        with pytest.raises(ValueError, match="^difficulty must be a number from 0 to 1, got"):
            WORLDS[name](0, difficulty)


@pytest.mark.parametrize(
    ("name", "task_area", "bounds", "spawn_height"),
    [
        ("forest", ((-4, 4), (-4, 4)), ((-5, 5), (-5, 5)), 0.75),
        ("hills", ((-6, 6), (-6, 6)), ((-10, 10), (-10, 10)), 0.75),
        ("rooms", ((-7, 7), (-7, 7)), ((-8, 8), (-8, 8)), 0.75),
        ("ramps", (pytest.approx((-8.2, 8.2)),) * 2, (pytest.approx((-8.8, 8.8)),) * 2, 0.75),
    ],
)
def test_names_areas_and_spawn_heights(name, task_area, bounds, spawn_height):
    """Those of the contract's worlds are in ``tests/envs/contract/test_worlds.py``."""
    world = WORLDS[name](1, 0.7)
    assert (world.name, world.bounds, world.spawn_height) == (name, bounds, spawn_height)
    assert world.spawn_range == world.goal_range == task_area


@pytest.mark.parametrize("name", NAMES)
def test_the_hardest_layouts_have_a_way_to_every_goal(name):
    world, robot = WORLDS[name](11, 1.0), get_robot("rover_zero")
    free = free_space(world, robot)
    assert min(len(free.spawn_cells), len(free.goal_cells)) > 500
    picks = torch.Generator().manual_seed(0)
    start = free.spawn_cells[torch.randint(len(free.spawn_cells), (4,), generator=picks)]
    goal = free.goal_cells[torch.randint(len(free.goal_cells), (4,), generator=picks)]
    lengths = shortest_paths(world, robot, start, goal)
    assert lengths.isfinite().all()
    assert (lengths >= (goal - start).norm(dim=1) - 0.5 - 1e-4).all()


@pytest.mark.parametrize("name", ["maze:3", "forest:3", "inspect:3@1", "moon:3"])
def test_points_are_inside_of_the_same_obstacles_on_the_same_ground_of_a_wider_world(name):
    world, wide = get_world(name), get_world(f"{name}*1.7")
    middle = torch.tensor(world.spawn_range, dtype=torch.float64).mean(1)
    noise = torch.rand(2000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    xy, upward = middle + 16 * (noise - 0.5), 1.0 if world.terrain.is_flat else 1.7
    moved, ground = middle + 1.7 * (xy - middle), world.height_at(xy)[:, None]
    assert torch.allclose(wide.height_at(moved)[:, None], upward * ground, atol=1e-6)
    points, wide_points = torch.cat((xy, ground + 0.3), -1), torch.cat((moved, upward * (ground + 0.3)), -1)
    for obstacle, other in zip(world.obstacles, wide.obstacles, strict=True):
        assert torch.equal(other.contains(wide_points), obstacle.contains(points))


def test_people_stay_as_large_as_they_are_where_ways_are_wider():
    for name in ("plaza:3", "corridor:3", "crossing:3", "field:3", "yard:3"):
        world, wide = get_world(name), get_world(f"{name}*1.5")
        assert [mover.shape for mover in wide.movers] == [mover.shape for mover in world.movers]
        for (low, high), (wide_low, wide_high) in zip(world.bounds, wide.bounds, strict=True):
            assert wide_high - wide_low == pytest.approx(1.5 * (high - low))
    assert len(get_world("maze+walkers:3*1.5").movers) > len(get_world("maze+walkers:3").movers)
    with pytest.raises(ValueError, match="has movers: only its function can scale it"):
        get_world("maze+walkers:3").scaled(1.5)


def test_only_worlds_whose_layout_can_be_larger_take_a_scale():
    names = {"maze:*": True, "maze:3*2": False, f"{UNSCALED}:3": False, "a/b.sdf": False}
    assert {name: takes_scale(name) for name in names} == names
    assert get_world("maze:3*1") is get_world("maze:3")
    assert get_world(f"{UNSCALED}:3*1") is get_world(f"{UNSCALED}:3")
    for name, part in ((f"{UNSCALED}:3*2", UNSCALED), ("yard.yaml*2", "yard.yaml")):
        with pytest.raises(ValueError, match=f"world '{part}' takes no scale, got 2"):
            get_world(name)


# Flat worlds


def increases(values) -> bool:
    return all(a < b for a, b in pairwise(values))


def rectangles(world) -> np.ndarray:
    """Left, bottom, right and top of the boxes of a world but its outer walls, ``[N, 4]``, m."""
    return np.array([[*o.vertices[:, :2].amin(0), *o.vertices[:, :2].amax(0)] for o in world.obstacles[4:]])


def covered(world, cell: float, side: float) -> np.ndarray:
    """Which cells of a grid around the origin are in a box, by their centers: bool ``[rows, columns]``."""
    axis = cell * (np.arange(round(side / cell)) + 0.5) - side / 2
    left, bottom, right, top = rectangles(world).T[:, :, None]
    in_x, in_y = (left < axis) & (axis < right), (bottom < axis) & (axis < top)
    return np.einsum("ny,nx->yx", in_y.astype(int), in_x.astype(int)) > 0


def squares(seed, difficulty) -> np.ndarray:
    """Blocked squares of the grid of a maze, with the walls around it: bool ``[22, 22]``."""
    return np.pad(covered(WORLDS["maze"](seed, difficulty), 1.0, 20.0), 1, constant_values=True)


@pytest.mark.parametrize("seed", SEEDS)
def test_free_squares_of_a_maze_are_connected_and_loops_turn_into_dead_ends(seed):
    loops, dead_ends = [], []
    for difficulty in DIFFICULTIES:
        free = ~squares(seed, difficulty)
        assert label(free)[1] == 1
        # Squares that touch only at a corner would leave a gap without width.
        a, b, c, d = free[:-1, :-1], free[:-1, 1:], free[1:, :-1], free[1:, 1:]
        assert not ((a == d) & (b == c) & (a != b)).any()
        # A rover can drive around each group of blocks apart from the walls.
        loops.append(label(~free)[1] - 1)
        sides = [np.roll(~free, shift, axis) for shift in (1, -1) for axis in (0, 1)]
        dead_ends.append((free & (np.sum(sides, axis=0) == 3)).sum())
    assert increases(loops[:1:-1])
    assert loops[-1] <= 0.4 * loops[2]
    assert dead_ends[4] > dead_ends[2]


@pytest.mark.parametrize("seed", SEEDS)
def test_blocks_of_a_maze(seed):
    counts = [len(WORLDS["maze"](seed, difficulty).obstacles) - 4 for difficulty in DIFFICULTIES]
    assert (counts[0], counts[2]) == (10, 36)
    assert increases(counts)
    world = WORLDS["maze"](seed)
    left, bottom, right, top = corners = rectangles(world).T
    assert np.allclose(corners, corners.round(), atol=1e-6)
    sizes = sorted(tuple(sorted(size)) for size in np.rint((right - left, top - bottom)).astype(int).T.tolist())
    assert sizes.count((2, 9)) == 1
    assert set(sizes) <= {(1, 1), (1, 2), (1, 3), (1, 4), (1, 5), (2, 9)}
    blocked = squares(seed, 0.5)[1:-1, 1:-1]
    assert blocked.sum() == sum(a * b for a, b in sizes), "blocks overlap"
    assert 0.25 <= blocked[6:14, 6:14].mean() <= 0.4
    assert {(float(o.vertices[:, 2].min()), float(o.vertices[:, 2].max())) for o in world.obstacles[4:]} == {(0.0, 1.0)}


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    corridor=st.integers(12, 20),
    smallest=st.integers(26, 42),
    door=st.integers(9, 14),
    extra=st.floats(0, 1),
)
def test_rooms_walls_and_doors_cover_the_building_once_and_are_connected(seed, corridor, smallest, door, extra):
    plan = floor_plan(np.random.default_rng(seed), 140, corridor, smallest, door, extra)
    count, free = np.zeros((140, 140), dtype=int), np.zeros((140, 140), dtype=bool)
    open_parts = {*plan.rooms, *plan.doors}
    for part in (*open_parts, *plan.walls):
        left, bottom, right, top = np.array(part) + 70
        assert right > left
        assert top > bottom
        count[bottom:top, left:right] += 1
        free[bottom:top, left:right] = part in open_parts
    assert (count == 1).all()
    assert label(free)[1] == 1
    assert all(min(door.size) == WALL for door in plan.doors)
    assert len(plan.doors) >= len(plan.rooms) - 1


def narrowest(world) -> float:
    """Width of the narrowest opening between two parts of a wall in line, m."""
    tall = [float(o.vertices[:, 2].max()) > 1.9 for o in world.obstacles[4:]]
    gaps = []
    for walls in (rectangles(world)[tall], rectangles(world)[tall][:, [1, 0, 3, 2]]):
        lines = [(w[1], w[0], w[2]) for w in walls if w[3] - w[1] < 0.11]
        gaps += [b[1] - a[2] for a in lines for b in lines if abs(a[0] - b[0]) < 1e-6 and b[1] - a[2] > 0.15]
    return min(gaps)


def test_rooms_get_smaller_and_fuller_and_doors_narrower():
    worlds = [[WORLDS["rooms"](seed, difficulty) for seed in range(8)] for difficulty in DIFFICULTIES]
    assert increases([np.mean([covered(world, 0.1, 14.0).mean() for world in level]) for level in worlds])
    widths = [min(map(narrowest, level)) for level in worlds]
    assert widths == pytest.approx([1.4, 1.2, 1.1, 1.0, 0.9], abs=0.11)


@pytest.mark.parametrize(("difficulty", "gap"), [(0.0, 1.2), (0.5, 0.9), (1.0, 0.7)])
def test_gaps_of_a_forest_connect_most_of_the_ground_between_the_clutter_of_the_barn_worlds(difficulty, gap):
    outlines = [solid.footprint.numpy() for solid in WORLDS["forest"](2, difficulty).obstacles]
    centers = np.array([outline.mean(0) for outline in outlines])
    radii = np.array([np.linalg.norm(o - c, axis=1).max() for o, c in zip(outlines, centers, strict=True)])
    thin = np.isclose(radii, 0.075)
    assert thin.sum() > 40
    cells = (centers[thin] + 4.875) / 0.15
    assert np.allclose(cells, cells.round(), atol=1e-6)
    assert len(np.unique(cells.round(), axis=0)) == thin.sum()
    assert ((radii[~thin] >= 0.12) & (radii[~thin] <= 0.3)).all()
    # Measured on a grid that is three times as fine as that of the generator.
    x, y = np.meshgrid(*[np.arange(-3.95, 4, 0.05)] * 2)
    clearance = np.min([np.hypot(x - u, y - v) - r for (u, v), r in zip(centers, radii, strict=True)], axis=0)
    # A gap that is just wide enough on the coarse grid is at most half a diagonal of its cells narrower or wider.
    parts = np.bincount(label(clearance >= gap / 2 - 0.08)[0].ravel())[1:]
    assert parts.max() >= 0.6 * (clearance >= gap / 2).sum()


def test_solids_of_a_forest_get_more():
    counts = [np.mean([len(WORLDS["forest"](seed, d).obstacles) for seed in range(5)]) for d in DIFFICULTIES]
    assert increases(counts)
    assert counts[-1] > 2 * counts[0]


# Uneven ground


def points(area, step: float = 0.1) -> torch.Tensor:
    x, y = (torch.arange(low + step / 2, high, step, dtype=torch.float64) for low, high in area)
    return torch.cartesian_prod(x, y)


def heights(world, area) -> np.ndarray:
    return world.height_at(points(area)).numpy()


def slopes(world, area=None, step: float = 0.1) -> np.ndarray:
    """Slopes of the ground in an area, by default the task area, degrees."""
    return np.degrees(np.arccos(world.terrain.normal_at(points(area or world.spawn_range, step))[:, 2].numpy()))


@pytest.mark.parametrize(("name", "least"), [("hills", 0.05), ("ramps", 0.01), ("inspect", None), ("moon", None)])
def test_the_ground_gets_steeper_and_more_of_it_impassable(name, least):
    ground = [np.stack([slopes(WORLDS[name](seed, level)) for seed in SEEDS]) for level in DIFFICULTIES[::2]]
    easy, default, hard = (each.mean() for each in ground)
    assert easy < default < hard
    easy, default, hard = ((each > np.degrees(MAX_SLOPE)).mean() for each in ground)
    assert least is None or easy < default < hard
    assert default > (least or -1)


@pytest.mark.parametrize(("difficulty", "gap"), [(0.0, 1.6), (0.5, 1.2), (1.0, 0.95)])
def test_boulders_of_the_moon_are_apart_partly_buried_and_visible_to_the_lidar(difficulty, gap):
    world = WORLDS["moon"](1, difficulty)
    outlines = [rock.footprint for rock in world.obstacles]
    assert sum(bool(outline.mean(0).abs().max() < 4) for outline in outlines) >= 2
    for k, rock in enumerate(world.obstacles):
        assert torch.cdist(outlines[k], torch.cat(outlines[:k] + outlines[k + 1 :])).min() >= gap
        ground = world.height_at(outlines[k].mean(0))
        assert rock.vertices[:, 2].min() < ground
        assert rock.vertices[:, 2].max() > ground + 0.38


@pytest.mark.parametrize("size", [4.0, 30.0])
def test_the_size_of_the_task_area_of_the_moon(size):
    world, half = moon(1, size=size), size / 2
    assert world.spawn_range == world.goal_range == ((-half, half), (-half, half))
    assert world.bounds == ((-half - 16, half + 6), (-half - 16, half + 16))
    assert world.terrain.extent == ((-half - 26, half + 26), (-half - 26, half + 26))
    inside = [bool(rock.footprint.mean(0).abs().max() < half) for rock in world.obstacles]
    assert 0.04 < sum(inside) / size**2 < 0.3


@pytest.mark.parametrize("size", [3.9, 65.0, float("nan")])
def test_a_size_of_the_moon_out_of_range_raises(size):
    with pytest.raises(ValueError, match="^size must be from 4 to 64 m, got"):
        moon(0, size=size)


@pytest.mark.parametrize("seed", range(2))
def test_the_ground_of_the_moon_is_gentle_and_descends_toward_the_edges(seed):
    world = moon(seed)
    middle, steep = np.quantile(slopes(world), (0.5, 0.9))
    assert middle < 8
    assert steep < 15
    ground = world.terrain.heights
    assert torch.cat((ground[0], ground[-1], ground[:, 0], ground[:, -1])).max() < -1.5


def test_the_ground_of_the_inspection_site_is_that_of_the_original():
    site = get_world("inspect")
    assert (site.terrain.extent, site.terrain.cell) == (((-32.0, 32.0), (-50.0, 50.0)), 0.25)
    window, square = heights(site, site.bounds), heights(site, site.spawn_range)
    assert 4.1 <= window.min() < window.max() <= 6.3
    assert 4.3 <= square.min() < square.max() <= 6.1
    assert np.quantile(slopes(site, site.bounds), (0.5, 0.75, 0.9)) == pytest.approx((9, 14, 19), abs=1.0)
    # It falls from the southwest to the east.
    corner = heights(site, ((-27, -26), (-27, -26)))
    assert 5.9 <= corner.min() < corner.max() <= 6.1
    assert square.max() <= corner.max() + 0.02
    assert heights(site, ((-19.5, -19), (-27, -19))).mean() == pytest.approx(4.4, abs=0.1)


@pytest.mark.parametrize("seed", range(2))
def test_structures_of_the_inspection_site_are_north_of_the_task_area_and_visible_to_the_lidar(seed):
    world = WORLDS["inspect"](seed)
    for obstacle in world.obstacles:
        assert obstacle.footprint[:, 1].min() > -19
        assert (obstacle.vertices[:, 2].max() - world.height_at(obstacle.footprint) > 0.45).all()
    middles = torch.stack([obstacle.footprint.mean(0) for obstacle in world.obstacles])
    low, high = torch.tensor(world.bounds).T
    assert ((middles > low) & (middles < high)).all(1).sum() >= 5


@pytest.mark.parametrize("seed", SEEDS)
def test_slopes_of_ramps_are_clearly_passable_or_not(seed):
    steep = slopes(WORLDS["ramps"](seed, 0.5), step=0.05)
    # In between are the corners of structures, and cells that the edges of round mounds cut.
    assert ((steep > 20) & (steep < 33)).mean() < 0.02
    assert (steep > 33).mean() > 0.02
    assert ((steep > 5) & (steep <= 20)).mean() > 0.02
