"""Generators of flat worlds: maze, rooms and forest. Their difficulty is measured."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import label

from rover_rl.worlds import WORLDS
from rover_rl.worlds.generators.rooms import WALL, floor_plan

DIFFICULTIES = (0.0, 0.25, 0.5, 0.75, 1.0)
SEEDS = range(3)


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
