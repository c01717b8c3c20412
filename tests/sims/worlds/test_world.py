"""World: defaults, validation, queries, and lookup by name."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl.sims.worlds import WORLDS, Terrain, World, box, get_world

FLOOR = Terrain.flat((10, 10))


def test_default_areas_follow_from_the_terrain():
    world = World("plain", FLOOR)
    assert world.bounds == ((-5.0, 5.0), (-5.0, 5.0))
    assert world.spawn_range == world.goal_range == ((-4.0, 4.0), (-4.0, 4.0))


def test_the_default_goal_area_is_the_spawn_area():
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


def test_get_world_returns_the_same_object_for_the_same_name():
    assert set(WORLDS) == {
        *("inspect", "moon", "maze", "rooms", "forest", "hills", "ramps"),
        *("plaza", "corridor", "crossing", "field"),
    }
    assert get_world("maze") is get_world("maze") is get_world("maze:0")
    assert get_world("maze:7") is get_world("maze:7")
    assert get_world("maze:7") is not get_world("maze")
    world = World("plain", FLOOR)
    assert get_world(world) is world


@pytest.mark.parametrize("name", ["mars", "maze:", "maze:x", "maze:-1", "maze:1.5", "", "Maze", ":1", "maze:²"])
def test_an_unknown_world_raises_with_the_known_names(name):
    with pytest.raises(ValueError) as error:
        get_world(name)
    assert str(error.value).startswith(f"unknown world {name!r}")
    assert str(error.value).endswith(
        f"; use one of {sorted(WORLDS)}, 'name:seed', 'name:seed@difficulty', the path of a file, a World, "
        "or 'module:attribute' of your own"
    )
