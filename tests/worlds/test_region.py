"""Regions, worlds whose starts and goals lie in one, and maps of worlds."""

from __future__ import annotations

import pytest
import torch
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space
from rover_rl.worlds import Region, Terrain, World, get_world
from rover_rl.worlds.draw import draw_map

FLOOR = Terrain.flat((20, 20))
ROVER = get_robot("rover_zero")
L_SHAPE = [(0, 0), (6, 0), (6, 2), (2, 2), (2, 6), (0, 6)]
ALL = torch.ones(2, 2, dtype=torch.bool)


def test_a_polygon_contains_what_is_within_its_corners():
    region = Region.polygon(L_SHAPE)
    points = torch.tensor([[1.0, 5.0], [5.0, 1.0], [5.0, 5.0], [-0.1, 1.0], [50.0, 50.0]], dtype=torch.float64)
    assert region.contains(points.reshape(5, 1, 2)).tolist() == [[True], [True], [False], [False], [False]]
    assert region.area == pytest.approx(20)
    assert region.bounds == (pytest.approx((0, 6)), pytest.approx((0, 6)))
    assert Region.polygon([(0, 0), (3, 1), (2, 4), (-1, 3)]).area == pytest.approx(10, rel=0.01)


def test_a_mask_is_cut_to_its_cells():
    mask = torch.zeros(5, 6, dtype=torch.bool)
    mask[2, 3:5] = True
    region = Region(mask, 0.5, (-1.0, 1.0))
    assert region.mask.tolist() == [[True, True]]
    assert region.bounds == ((0.5, 1.5), (2.0, 2.5))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Region(~ALL, 0.1, (0, 0)), "with a true cell"),
        (lambda: Region(ALL.float(), 0.1, (0, 0)), "must be bool"),
        (lambda: Region(ALL, 0.0, (0, 0)), "positive cell"),
        (lambda: Region.polygon([(0, 0), (1, 1)]), "at least three corners"),
        (lambda: Region.polygon([(0, 0), (1, 0), (2, 0)]), "has no area"),
    ],
)
def test_bad_regions_get_one_sentence(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_starts_and_goals_lie_in_the_regions_of_a_world():
    spawn, goal = Region.polygon(L_SHAPE), Region.polygon([(-6, -6), (-2, -6), (-2, -2)])
    world = World("halls", FLOOR, spawn_region=spawn, goal_region=goal)
    assert (world.spawn_range, world.goal_range) == (spawn.bounds, goal.bounds)
    space = free_space(world, ROVER)
    for cells, region in ((space.spawn_cells, spawn), (space.goal_cells, goal)):
        assert len(cells) > 500
        offsets = 0.049 * torch.tensor([(x, y) for x in (-1, 1) for y in (-1, 1)])
        assert region.contains(cells + offsets[:, None]).all()
    assert World("both", FLOOR, spawn_region=spawn).goal_region is spawn
    assert World("rest", FLOOR, spawn_region=spawn, goal_range=((0, 8), (0, 8))).goal_region is None
    half = free_space(World("half", FLOOR, spawn_range=((0, 2), (0, 6)), spawn_region=spawn), ROVER)
    assert half.spawn_cells[:, 0].max() < 2


@pytest.mark.parametrize(("world", "is_flat"), [(get_world("moon"), False), (World("plain", FLOOR), True)])
def test_a_map_has_the_limits_of_its_area_the_obstacles_and_a_scale_of_elevation(world, is_flat):
    ax = Figure().add_subplot()
    assert (draw_map(ax, world, ((-4, 4), (-2, 3))) is None) == is_flat
    assert (ax.get_xlim(), ax.get_ylim()) == ((-4, 4), (-2, 3))
    (outlines,) = (part for part in ax.collections if isinstance(part, PolyCollection))
    assert len(outlines.get_paths()) == len(world.obstacles)
    draw_map(ax, world)
    assert ax.get_xlim() == world.terrain.extent[0]
