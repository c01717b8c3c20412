"""Properties of the built-in worlds."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import label

from rover_rl.sims.free_space import free_space
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import WORLDS, World, get_world

SEEDS = range(12)


def points(area, step=0.1):
    x, y = (torch.arange(low + step / 2, high, step, dtype=torch.float64) for low, high in area)
    return torch.cartesian_prod(x, y)


def heights(world, area):
    return world.height_at(points(area)).numpy()


def slopes(world, area):
    """Returns the slopes of the ground in an area, degrees."""
    return np.degrees(np.arccos(world.normal_at(points(area))[:, 2].numpy()))


@pytest.mark.parametrize(
    ("name", "task_area", "bounds", "spawn_height"),
    [
        ("inspect", ((-27, -19), (-27, -19)), ((-29, -13), (-29, -17)), 5.5),
        ("moon", ((-4, 4), (-4, 4)), ((-20, 10), (-20, 20)), 0.75),
        ("maze", ((-4, 4), (-4, 4)), ((-30, 30), (-30, 30)), 0.75),
    ],
)
def test_areas_and_spawn_heights_of_the_contract(name, task_area, bounds, spawn_height):
    world = get_world(name)
    assert world.name == name
    assert world.spawn_range == world.goal_range == task_area
    assert world.bounds == bounds
    assert world.spawn_height == spawn_height


def test_the_southwest_corner_of_inspect_has_a_different_spawn_height():
    xy = torch.tensor([[-24.6, -24.6], [-24.4, -24.6], [-24.6, -24.4], [-24.5, -24.5]])
    assert get_world("inspect").drop_height(xy).tolist() == [6.5, 5.5, 5.5, 5.5]


@pytest.mark.parametrize("name", sorted(WORLDS))
def test_a_world_is_determined_by_its_seed(name):
    a, b, other = WORLDS[name](3), WORLDS[name](3), WORLDS[name](4)
    assert torch.equal(a.terrain.heights, b.terrain.heights)
    assert all(torch.equal(p.vertices, q.vertices) for p, q in zip(a.obstacles, b.obstacles, strict=True))
    same_ground = torch.equal(a.terrain.heights, other.terrain.heights)
    same_obstacles = all(torch.equal(p.vertices, q.vertices) for p, q in zip(a.obstacles, other.obstacles, strict=True))
    assert a.movers == b.movers
    assert not (same_ground and same_obstacles and a.movers == other.movers)


@pytest.mark.parametrize("name", sorted(WORLDS))
@pytest.mark.parametrize("seed", [1, 2])
def test_other_seeds_have_free_space(name, seed):
    free = free_space(get_world(f"{name}:{seed}"), get_robot("rover_zero"))
    assert min(len(free.spawn_cells), len(free.goal_cells)) > 1000


class TestInspect:
    def world(self) -> World:
        return get_world("inspect")

    def test_terrain_is_64_by_100_meters(self):
        assert self.world().terrain.extent == ((-32.0, 32.0), (-50.0, 50.0))
        assert self.world().terrain.cell == 0.25

    def test_heights(self):
        window, square = (heights(self.world(), self.world().bounds), heights(self.world(), self.world().spawn_range))
        assert window.min() >= 4.1
        assert window.max() <= 6.3
        assert square.min() >= 4.3
        assert square.max() <= 6.1

    def test_the_southwest_corner_is_the_highest(self):
        corner = heights(self.world(), ((-27, -26), (-27, -26)))
        assert corner.min() >= 5.9
        assert corner.max() <= 6.1
        assert heights(self.world(), self.world().spawn_range).max() <= corner.max() + 0.02

    def test_the_ground_falls_to_the_east(self):
        assert heights(self.world(), ((-19.5, -19), (-27, -19))).mean() == pytest.approx(4.4, abs=0.1)

    def test_slopes(self):
        quantiles = np.quantile(slopes(self.world(), self.world().bounds), (0.5, 0.75, 0.9))
        assert quantiles == pytest.approx((9, 14, 19), abs=1.0)

    def test_the_ground_has_no_short_bumps(self):
        """Neighboring slopes are similar, so that a small wheel rolls over the ground."""
        grid = self.world().terrain.heights.numpy()[80:140, 8:80]
        bend = np.abs(np.diff(grid, 2, axis=1))
        assert np.quantile(bend, 0.99) < 0.1

    @pytest.mark.parametrize("seed", range(4))
    def test_structures_are_north_of_the_task_area_and_visible_to_the_lidar(self, seed):
        world = get_world(f"inspect:{seed}")
        for obstacle in world.obstacles:
            outline = obstacle.footprint
            assert outline[:, 1].min() > -19
            reach = obstacle.vertices[:, 2].max() - world.height_at(outline)
            assert (reach > 0.45).all()

    def test_panels_have_closed_stands(self):
        """The space below every panel is solid at the lidar's height, so that rovers cannot drive under it."""
        world = self.world()
        panels = [o for o in world.obstacles if o.planes.shape[0] == 6 and _is_tilted(o)]
        assert len(panels) == 20
        for panel in panels:
            xy = panel.footprint.mean(0) + 0.85 * (panel.footprint - panel.footprint.mean(0))
            under = torch.cat((xy, world.height_at(xy)[:, None] + 0.32), -1)
            assert world.inside(under).all()

    def test_some_structures_are_within_the_bounds(self):
        middles = torch.stack([o.footprint.mean(0) for o in self.world().obstacles])
        (x_low, x_high), (y_low, y_high) = self.world().bounds
        x, y = middles.unbind(1)
        assert ((x > x_low) & (x < x_high) & (y > y_low) & (y < y_high)).sum() >= 5


def _is_tilted(obstacle) -> bool:
    up = obstacle.planes[:, 2].abs()
    return bool(((up > 0.1) & (up < 0.95)).sum() >= 4)


class TestMoon:
    @pytest.mark.parametrize("seed", range(4))
    def test_slopes_of_the_task_area_are_gentle(self, seed):
        world = get_world(f"moon:{seed}")
        assert np.median(slopes(world, world.spawn_range)) < 8
        assert np.quantile(slopes(world, world.spawn_range), 0.9) < 15

    def test_median_slope_of_the_default_seed(self):
        world = get_world("moon")
        assert 2 < np.median(slopes(world, world.spawn_range)) < 6

    def test_the_ground_descends_toward_the_edges(self):
        terrain = get_world("moon").terrain
        edge = torch.cat((terrain.heights[0], terrain.heights[-1], terrain.heights[:, 0], terrain.heights[:, -1]))
        assert edge.max() < -1.5

    @pytest.mark.parametrize("seed", range(4))
    def test_boulders_are_partly_buried_and_visible_to_the_lidar(self, seed):
        world = get_world(f"moon:{seed}")
        for rock in world.obstacles:
            ground = world.height_at(rock.footprint.mean(0))
            assert rock.vertices[:, 2].min() < ground
            assert rock.vertices[:, 2].max() > ground + 0.38

    @pytest.mark.parametrize("seed", range(4))
    def test_some_boulders_are_in_the_task_area(self, seed):
        middles = torch.stack([rock.footprint.mean(0) for rock in get_world(f"moon:{seed}").obstacles])
        assert (middles.abs().amax(1) < 4).sum() >= 4


def squares(world):
    """Returns the number of blocks that cover each square of the maze's grid: ``[20, 20]``."""
    covered = np.zeros((20, 20), dtype=int)
    for block in world.obstacles[4:]:
        (x_low, y_low), (x_high, y_high) = block.footprint.aminmax(dim=0)
        corners = [round(float(v), 6) + 10 for v in (x_low, y_low, x_high, y_high)]
        assert all(corner == int(corner) for corner in corners)
        left, bottom, right, top = map(int, corners)
        covered[bottom:top, left:right] += 1
    return covered


class TestMaze:
    def test_the_floor_is_flat(self):
        terrain = get_world("maze").terrain
        assert terrain.is_flat
        assert terrain.extent == ((-10.0, 10.0), (-10.0, 10.0))

    def test_walls_of_2_meters_enclose_the_floor(self):
        walls = get_world("maze").obstacles[:4]
        assert all(float(wall.vertices[:, 2].max()) == 2.0 for wall in walls)
        angle = torch.linspace(0, 2 * math.pi, 721, dtype=torch.float64)
        border = torch.stack((angle.cos(), angle.sin()), -1)
        border = 10.1 * border / border.abs().amax(1, keepdim=True)
        at = torch.cat((border, torch.ones(len(border), 1)), -1)
        assert torch.stack([wall.contains(at) for wall in walls]).any(0).all()

    @pytest.mark.parametrize("seed", SEEDS)
    def test_number_and_sizes_of_blocks(self, seed):
        blocks = WORLDS["maze"](seed).obstacles[4:]
        assert len(blocks) == 36
        sizes = sorted(
            tuple(sorted(round(float(side)) for side in (high - low)[:2]))
            for low, high in (b.vertices.aminmax(dim=0) for b in blocks)
        )
        assert sizes.count((2, 9)) == 1
        assert set(sizes) <= {(1, 1), (1, 2), (1, 3), (1, 4), (1, 5), (2, 9)}
        assert all((float(b.vertices[:, 2].min()), float(b.vertices[:, 2].max())) == (0.0, 1.0) for b in blocks)

    @pytest.mark.parametrize("seed", SEEDS)
    def test_corridors_are_connected_and_1_meter_wide(self, seed):
        covered = squares(WORLDS["maze"](seed))
        assert covered.max() == 1
        free = covered == 0
        assert label(free)[1] == 1
        # Squares that touch only at a corner would leave a gap without width.
        a, b, c, d = free[:-1, :-1], free[:-1, 1:], free[1:, :-1], free[1:, 1:]
        assert not ((a == d) & (b == c) & (a != b)).any()

    @pytest.mark.parametrize("seed", SEEDS)
    def test_blocks_cover_25_to_40_percent_of_the_task_area(self, seed):
        middle = squares(WORLDS["maze"](seed))[6:14, 6:14]
        assert 0.25 <= middle.mean() <= 0.4
