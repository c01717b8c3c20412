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
    return np.degrees(np.arccos(world.terrain.normal_at(points(area or world.spawn_range, step))[:, 2].numpy()))


@pytest.mark.parametrize(("name", "least"), [("hills", 0.05), ("ramps", 0.01), ("inspect", None), ("moon", None)])
def test_the_ground_gets_steeper_and_more_of_it_impassable(name, least):
    ground = [np.stack([slopes(WORLDS[name](seed, level)) for seed in range(3)]) for level in DIFFICULTIES]
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
    # A live rover is dropped from higher up in the southwest.
    xy = torch.tensor([[-24.6, -24.6], [-24.4, -24.6], [-24.6, -24.4], [-24.5, -24.5]])
    assert site.drop_height(xy).tolist() == [6.5, 5.5, 5.5, 5.5]


@pytest.mark.parametrize("seed", range(2))
def test_structures_of_the_inspection_site_are_north_of_the_task_area_and_visible_to_the_lidar(seed):
    world = WORLDS["inspect"](seed)
    for obstacle in world.obstacles:
        assert obstacle.footprint[:, 1].min() > -19
        assert (obstacle.vertices[:, 2].max() - world.height_at(obstacle.footprint) > 0.45).all()
    middles = torch.stack([obstacle.footprint.mean(0) for obstacle in world.obstacles])
    low, high = torch.tensor(world.bounds).T
    assert ((middles > low) & (middles < high)).all(1).sum() >= 5


@pytest.mark.parametrize("seed", range(3))
def test_slopes_of_ramps_are_clearly_passable_or_not(seed):
    steep = slopes(WORLDS["ramps"](seed, 0.5), step=0.05)
    # In between are the corners of structures, and cells that the edges of round mounds cut.
    assert ((steep > 20) & (steep < 33)).mean() < 0.02
    assert (steep > 33).mean() > 0.02
    assert ((steep > 5) & (steep <= 20)).mean() > 0.02
