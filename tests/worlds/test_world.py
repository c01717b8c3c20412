"""World: defaults, validation, and queries."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl.worlds import Terrain, World, box

FLOOR = Terrain.flat((10, 10))


def test_default_areas_follow_from_the_terrain_and_the_spawn_area():
    world = World("plain", FLOOR)
    assert world.bounds == ((-5.0, 5.0), (-5.0, 5.0))
    assert world.spawn_range == world.goal_range == ((-4.0, 4.0), (-4.0, 4.0))
    area = ((-1.0, 1.0), (-2.0, 2.0))
    assert World("plain", FLOOR, spawn_range=area).goal_range == area


@pytest.mark.parametrize("field", ["spawn_range", "goal_range", "bounds"])
@pytest.mark.parametrize("area", [((2.0, 1.0), (0.0, 1.0)), ((0.0, 1.0), (math.nan, 1.0))])
def test_areas_with_ends_out_of_order_raise(field, area):
    with pytest.raises(ValueError, match=f"{field} of world 'plain' must be"):
        World("plain", FLOOR, **{field: area})


@pytest.mark.parametrize("field", ["spawn_range", "goal_range"])
def test_areas_beyond_the_bounds_raise(field):
    with pytest.raises(ValueError, match=f"{field} of world 'plain' must lie in its bounds"):
        World("plain", FLOOR, **{field: ((-6.0, 0.0), (0.0, 1.0))})


def test_inside_includes_the_ground_and_the_obstacles():
    world = World("plain", FLOOR, [box((2, 0, 0.5), (1, 1, 1))])
    points = torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.0, -0.1], [2.0, 0.0, 0.5], [2.0, 0.0, 1.1]])
    assert world.inside(points).tolist() == [False, True, True, False]


def test_the_first_area_that_contains_a_point_sets_its_drop_height():
    everywhere, east = ((-9.0, 9.0), (-9.0, 9.0)), ((0.0, 9.0), (-9.0, 9.0))
    world = World("plain", FLOOR, spawn_height_areas=((east, 3.0), (everywhere, 2.0)))
    points = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [10.0, 0.0]])
    assert world.drop_height(points).tolist() == [3.0, 2.0, 0.75]
