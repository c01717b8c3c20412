"""Generators of flat worlds: maze, rooms and forest. Their difficulty is measured."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
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


class TestMaze:
    def squares(self, seed, difficulty) -> np.ndarray:
        """Blocked squares of the grid, with the walls around it: bool ``[22, 22]``."""
        return np.pad(covered(WORLDS["maze"](seed, difficulty), 1.0, 20.0), 1, constant_values=True)

    @pytest.mark.parametrize("difficulty", DIFFICULTIES)
    @pytest.mark.parametrize("seed", SEEDS)
    def test_free_squares_are_connected(self, seed, difficulty):
        free = ~self.squares(seed, difficulty)
        assert label(free)[1] == 1
        # Squares that touch only at a corner would leave a gap without width.
        a, b, c, d = free[:-1, :-1], free[:-1, 1:], free[1:, :-1], free[1:, 1:]
        assert not ((a == d) & (b == c) & (a != b)).any()

    @pytest.mark.parametrize("seed", range(12))
    def test_blocks_of_the_default_difficulty(self, seed):
        world = WORLDS["maze"](seed)
        left, bottom, right, top = corners = rectangles(world).T
        assert np.allclose(corners, corners.round(), atol=1e-6)
        sizes = sorted(tuple(sorted(size)) for size in np.rint((right - left, top - bottom)).astype(int).T.tolist())
        assert len(sizes) == 36
        assert sizes.count((2, 9)) == 1
        assert set(sizes) <= {(1, 1), (1, 2), (1, 3), (1, 4), (1, 5), (2, 9)}
        squares = self.squares(seed, 0.5)[1:-1, 1:-1]
        assert squares.sum() == sum(a * b for a, b in sizes), "blocks overlap"
        assert 0.25 <= squares[6:14, 6:14].mean() <= 0.4
        heights = {(float(o.vertices[:, 2].min()), float(o.vertices[:, 2].max())) for o in world.obstacles[4:]}
        assert heights == {(0.0, 1.0)}

    @pytest.mark.parametrize("seed", SEEDS)
    def test_blocks_get_more_with_the_difficulty(self, seed):
        counts = [len(WORLDS["maze"](seed, difficulty).obstacles) - 4 for difficulty in DIFFICULTIES]
        assert counts[0] == 10
        assert counts[2] == 36
        assert increases(counts)

    @pytest.mark.parametrize("seed", SEEDS)
    def test_loops_turn_into_dead_ends(self, seed):
        """Each group of blocks apart from the walls is one that a rover can drive around."""
        squares = [self.squares(seed, difficulty) for difficulty in (0.5, 0.75, 1.0)]
        loops = [label(blocked)[1] - 1 for blocked in squares]
        assert increases(loops[::-1])
        assert loops[-1] <= 0.4 * loops[0]
        dead_ends = [self.dead_ends(blocked) for blocked in squares]
        assert dead_ends[2] > dead_ends[0]

    def dead_ends(self, blocked: np.ndarray) -> int:
        sides = [np.roll(blocked, shift, axis) for shift in (1, -1) for axis in (0, 1)]
        return int((~blocked & (np.sum(sides, axis=0) == 3)).sum())


class TestRooms:
    @settings(max_examples=50, deadline=None)
    @given(
        seed=st.integers(0, 10**6),
        corridor=st.integers(12, 20),
        smallest=st.integers(26, 42),
        door=st.integers(9, 14),
        extra=st.floats(0, 1),
    )
    def test_rooms_walls_and_doors_cover_the_building_once_and_are_connected(
        self, seed, corridor, smallest, door, extra
    ):
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

    def test_rooms_get_smaller_and_fuller_and_doors_narrower(self):
        share, free_width = [], []
        for difficulty in DIFFICULTIES:
            worlds = [WORLDS["rooms"](seed, difficulty) for seed in range(8)]
            share.append(np.mean([covered(world, 0.1, 14.0).mean() for world in worlds]))
            free_width.append(min(self.narrowest(world) for world in worlds))
        assert increases(share)
        assert free_width == pytest.approx([1.4, 1.2, 1.1, 1.0, 0.9], abs=0.11)

    def narrowest(self, world) -> float:
        """Width of the narrowest opening between two parts of a wall in line, m."""
        walls = [
            tuple(box)
            for o, box in zip(world.obstacles[4:], rectangles(world), strict=True)
            if o.vertices[:, 2].max() > 1.9
        ]
        gaps = []
        for x, y in ((0, 1), (1, 0)):
            lines = [(w[y], w[x], w[x + 2]) for w in walls if w[y + 2] - w[y] < 0.11]
            gaps += [b[1] - a[2] for a in lines for b in lines if abs(a[0] - b[0]) < 1e-6 and b[1] - a[2] > 0.15]
        return min(gaps)


class TestForest:
    def solids(self, world):
        """Centers ``[N, 2]`` and radii ``[N]`` of the cylinders, m."""
        centers = torch.stack([o.footprint.mean(0) for o in world.obstacles])
        radii = torch.stack([(o.footprint - o.footprint.mean(0)).norm(dim=1).max() for o in world.obstacles])
        return centers.numpy(), radii.numpy()

    @pytest.mark.parametrize("difficulty", [0.0, 0.5, 1.0])
    def test_clutter_is_that_of_the_barn_worlds(self, difficulty):
        centers, radii = self.solids(WORLDS["forest"](2, difficulty))
        thin = np.isclose(radii, 0.075)
        assert thin.sum() > 40
        cells = (centers[thin] + 4.875) / 0.15
        assert np.allclose(cells, cells.round(), atol=1e-6)
        assert len(np.unique(cells.round(), axis=0)) == thin.sum()
        assert ((radii[~thin] >= 0.12) & (radii[~thin] <= 0.3)).all()

    def test_solids_get_more(self):
        counts = [np.mean([len(WORLDS["forest"](seed, d).obstacles) for seed in range(10)]) for d in DIFFICULTIES]
        assert increases(counts)
        assert counts[-1] > 2 * counts[0]

    @pytest.mark.parametrize(("difficulty", "gap"), [(0.0, 1.2), (0.5, 0.9), (1.0, 0.7)])
    @pytest.mark.parametrize("seed", SEEDS)
    def test_gaps_connect_most_of_the_open_ground(self, seed, difficulty, gap):
        """Measured on a grid that is three times as fine as that of the generator."""
        centers, radii = self.solids(WORLDS["forest"](seed, difficulty))
        axis = np.arange(-3.95, 4, 0.05)
        x, y = np.meshgrid(axis, axis)
        clearance = np.min([np.hypot(x - u, y - v) - r for (u, v), r in zip(centers, radii, strict=True)], axis=0)
        # A gap that is just wide enough on the coarse grid is at most half a diagonal of its cells narrower or wider.
        parts = np.bincount(label(clearance >= gap / 2 - 0.08)[0].ravel())[1:]
        assert parts.max() >= 0.6 * (clearance >= gap / 2).sum()
