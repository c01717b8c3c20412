"""Generators of worlds with uneven ground: moon, inspect, hills and ramps. Their difficulty is measured."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rover_rl.worlds import WORLDS, get_world
from rover_rl.worlds.generators import moon
from rover_rl.worlds.terrain import MAX_SLOPE

DIFFICULTIES = (0.0, 0.5, 1.0)


def points(area, step: float = 0.1) -> torch.Tensor:
    x, y = (torch.arange(low + step / 2, high, step, dtype=torch.float64) for low, high in area)
    return torch.cartesian_prod(x, y)


def heights(world, area) -> np.ndarray:
    return world.height_at(points(area)).numpy()


def slopes(world, area=None, step: float = 0.1) -> np.ndarray:
    """Slopes of the ground in an area, by default the task area, degrees."""
    return np.degrees(np.arccos(world.normal_at(points(area or world.spawn_range, step))[:, 2].numpy()))


def mean_slope(name: str, difficulty: float) -> float:
    return float(np.mean([slopes(WORLDS[name](seed, difficulty)).mean() for seed in range(3)]))


@pytest.mark.parametrize("name", ["hills", "inspect", "moon", "ramps"])
def test_the_ground_gets_steeper(name):
    easy, default, hard = (mean_slope(name, difficulty) for difficulty in DIFFICULTIES)
    assert easy < default < hard


@pytest.mark.parametrize("name", ["hills", "ramps"])
def test_more_of_the_ground_is_impassable(name):
    shares = [
        np.mean([(slopes(WORLDS[name](seed, d)) > np.degrees(MAX_SLOPE)).mean() for seed in range(3)])
        for d in DIFFICULTIES
    ]
    assert shares[0] < shares[1] < shares[2]
    assert shares[1] > 0.05 if name == "hills" else shares[1] > 0.01


class TestMoon:
    def boulders(self, world) -> np.ndarray:
        """Centers of the boulders, ``[N, 2]``, m."""
        return torch.stack([o.footprint.mean(0) for o in world.obstacles]).numpy()

    @pytest.mark.parametrize(("difficulty", "gap"), [(0.0, 1.6), (0.5, 1.2), (1.0, 0.95)])
    def test_gaps_between_boulders(self, difficulty, gap):
        for seed in range(3):
            world = WORLDS["moon"](seed, difficulty)
            for k, rock in enumerate(world.obstacles):
                others = torch.cat([o.footprint for o in (*world.obstacles[:k], *world.obstacles[k + 1 :])])
                assert torch.cdist(rock.footprint, others).min() >= gap

    @pytest.mark.parametrize("size", [4.0, 16.0, 30.0])
    def test_the_size_of_the_task_area(self, size):
        world = moon(1, size=size)
        half = size / 2
        assert world.spawn_range == world.goal_range == ((-half, half), (-half, half))
        assert world.bounds == ((-half - 16, half + 6), (-half - 16, half + 16))
        assert world.terrain.extent == ((-half - 26, half + 26), (-half - 26, half + 26))
        density = (np.abs(self.boulders(world)).max(1) < half).sum() / size**2
        assert 0.04 < density < 0.3

    @pytest.mark.parametrize("size", [3.9, 65.0, float("nan")])
    def test_a_size_out_of_range_raises(self, size):
        with pytest.raises(ValueError, match="^size must be from 4 to 64 m, got"):
            moon(0, size=size)

    @pytest.mark.parametrize("seed", range(4))
    def test_the_ground_is_gentle_and_descends_toward_the_edges(self, seed):
        world = moon(seed)
        middle, steep = np.quantile(slopes(world), (0.5, 0.9))
        assert middle < 8
        assert steep < 15
        assert seed or 2 < middle < 6
        ground = world.terrain.heights
        assert torch.cat((ground[0], ground[-1], ground[:, 0], ground[:, -1])).max() < -1.5

    @pytest.mark.parametrize("seed", range(4))
    def test_boulders_are_partly_buried_and_visible_to_the_lidar(self, seed):
        world = moon(seed)
        assert (np.abs(self.boulders(world)).max(1) < 4).sum() >= 4
        for rock in world.obstacles:
            ground = world.height_at(rock.footprint.mean(0))
            assert rock.vertices[:, 2].min() < ground
            assert rock.vertices[:, 2].max() > ground + 0.38


class TestInspect:
    @pytest.fixture
    def site(self):
        return get_world("inspect")

    def test_the_ground_is_that_of_the_original_site(self, site):
        assert site.terrain.extent == ((-32.0, 32.0), (-50.0, 50.0))
        assert site.terrain.cell == 0.25
        window, square = heights(site, site.bounds), heights(site, site.spawn_range)
        assert window.min() >= 4.1
        assert window.max() <= 6.3
        assert square.min() >= 4.3
        assert square.max() <= 6.1
        quantiles = np.quantile(slopes(site, site.bounds), (0.5, 0.75, 0.9))
        assert quantiles == pytest.approx((9, 14, 19), abs=1.0)
        # It falls from the southwest to the east.
        corner = heights(site, ((-27, -26), (-27, -26)))
        assert corner.min() >= 5.9
        assert corner.max() <= 6.1
        assert square.max() <= corner.max() + 0.02
        assert heights(site, ((-19.5, -19), (-27, -19))).mean() == pytest.approx(4.4, abs=0.1)

    def test_the_southwest_corner_has_a_different_spawn_height(self, site):
        xy = torch.tensor([[-24.6, -24.6], [-24.4, -24.6], [-24.6, -24.4], [-24.5, -24.5]])
        assert site.drop_height(xy).tolist() == [6.5, 5.5, 5.5, 5.5]

    @pytest.mark.parametrize("seed", range(4))
    def test_structures_are_north_of_the_task_area_and_visible_to_the_lidar(self, seed):
        world = WORLDS["inspect"](seed)
        for obstacle in world.obstacles:
            assert obstacle.footprint[:, 1].min() > -19
            reach = obstacle.vertices[:, 2].max() - world.height_at(obstacle.footprint)
            assert (reach > 0.45).all()
        middles = torch.stack([obstacle.footprint.mean(0) for obstacle in world.obstacles])
        low, high = torch.tensor(world.bounds).T
        assert ((middles > low) & (middles < high)).all(1).sum() >= 5


class TestRamps:
    @pytest.mark.parametrize("seed", range(6))
    def test_slopes_are_clearly_passable_or_not(self, seed):
        steep = slopes(WORLDS["ramps"](seed, 0.5), step=0.05)
        # In between are the corners of structures, and cells that the edges of round mounds cut.
        assert ((steep > 20) & (steep < 33)).mean() < 0.02
        assert (steep > 33).mean() > 0.02
        assert ((steep > 5) & (steep <= 20)).mean() > 0.02
