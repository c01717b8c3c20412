"""Worlds: defaults, validation, queries, names, and registration."""

from __future__ import annotations

import math
from itertools import count

import pytest
import torch

from rover_rl.worlds import WORLDS, Terrain, World, box, get_world, register_world, world_names

FLOOR = Terrain.flat((10, 10))
NEW_NAMES = (f"registered-{number}" for number in count())
"""Names that no test has used: worlds are cached by name."""
registers = pytest.mark.usefixtures("own_registries")


def test_default_areas_follow_from_the_terrain_and_the_spawn_area():
    world = World("plain", FLOOR)
    assert world.bounds == ((-5.0, 5.0), (-5.0, 5.0))
    assert world.spawn_range == world.goal_range == ((-4.0, 4.0), (-4.0, 4.0))
    area = ((-1.0, 1.0), (-2.0, 2.0))
    assert World("plain", FLOOR, spawn_range=area).goal_range == area


@pytest.mark.parametrize("field", ["spawn_range", "goal_range", "bounds"])
def test_areas_with_ends_out_of_order_or_beyond_the_bounds_raise(field):
    for area in (((2.0, 1.0), (0.0, 1.0)), ((0.0, 1.0), (math.nan, 1.0))):
        with pytest.raises(ValueError, match=f"{field} of world 'plain' must be"):
            World("plain", FLOOR, **{field: area})
    if field != "bounds":
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


def test_a_name_gives_the_layout_of_its_function_and_always_the_same_object():
    still = ("inspect", "moon", "maze", "rooms", "forest", "hills", "ramps")
    assert {*WORLDS} == {*still, "plaza", "corridor", "crossing", "field", "yard"}
    for name, arguments in (("maze:4@0.75", (4, 0.75)), ("maze@0.75", (0, 0.75)), ("maze:7", (7,))):
        assert torch.equal(get_world(name).obstacles.vertices, WORLDS["maze"](*arguments).obstacles.vertices)
        assert get_world(name) is get_world(name)
    assert get_world("maze") is get_world("maze:0")
    assert get_world("maze:7") is not get_world("maze")
    world = World("plain", FLOOR)
    assert get_world(world) is world


def seeded(seed: int) -> World:
    return World(f"seed {seed}", FLOOR)


def canyon(seed: int = 0, difficulty: float = 0.2) -> World:
    return World(f"canyon {seed} {difficulty:g}", FLOOR)


def slope(difficulty: float) -> World:
    return World(f"slope {difficulty:g}", FLOOR)


@registers
@pytest.mark.parametrize(
    ("part", "suffix", "expected"),
    [
        (seeded, "", "seed 0"),
        (seeded, ":3", "seed 3"),
        (canyon, "", "canyon 0 0.2"),
        (canyon, "@0.9", "canyon 0 0.9"),
        (f"{__name__}:canyon", ":7@0.9", "canyon 7 0.9"),
        (slope, "@0.4", "slope 0.4"),
        (lambda: seeded(5), "", "seed 5"),
        (seeded(1), "", "seed 1"),
    ],
)
def test_registered_worlds(part, suffix, expected):
    name = next(NEW_NAMES)
    register_world(name, part)
    assert name in world_names()
    world = get_world(name + suffix)
    assert world.name == expected
    assert get_world(name + suffix) is world
    if isinstance(part, str):
        assert get_world(part + suffix).name == expected


@registers
@pytest.mark.parametrize(
    ("part", "suffix", "message"),
    [
        (seeded, ":1@0.3", "takes no difficulty, got 0.3"),
        (seeded(1), "@0.3", "takes no difficulty, got 0.3"),
        (seeded(1), ":0", "takes no seed, got 0"),
        (lambda: seeded(5), ":3", "takes no seed, got 3"),
        (slope, ":2@0.4", "takes no seed, got 2"),
        (lambda seed: None, "", "must be a World or a function that returns one, got NoneType"),
        (FLOOR, "", "must be a World or a function that returns one, got Terrain"),
    ],
)
def test_what_a_registered_part_does_not_give(part, suffix, message):
    name = next(NEW_NAMES)
    register_world(name, part)
    with pytest.raises(ValueError, match=f"^world '{name}' {message}$"):
        get_world(name + suffix)


@registers
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("maze", "^a world named 'maze' already exists; choose another name$"),
        ("registered:3", "^the name of a world must consist of letters"),
    ],
)
def test_names_that_cannot_be_registered(name, message):
    with pytest.raises(ValueError, match=message):
        register_world(name, seeded)


@pytest.mark.parametrize("name", ["mars", "maze:", "maze:x", "maze:-1", "maze:1.5", "", ":1", "maze:²"])
def test_an_unknown_world_raises_with_the_known_names(name):
    with pytest.raises(ValueError, match="^unknown world ") as error:
        get_world(name)
    assert f"{name!r}" in str(error.value)
    assert f"; use one of {sorted(WORLDS)}, 'name:seed'" in str(error.value)
