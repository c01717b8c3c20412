"""Worlds by name, and registration."""

from __future__ import annotations

from itertools import count

import pytest
import torch

from rover_rl.worlds import WORLDS, Terrain, World, get_world, register_world, world_names

pytestmark = pytest.mark.usefixtures("own_registries")
FLOOR = Terrain.flat((10, 10))
NEW_NAMES = (f"registered-{number}" for number in count())
"""Names that no test has used: worlds are cached by name."""


@pytest.mark.parametrize("name", ["maze", "forest"])
def test_the_name_gives_the_layout_of_the_function(name):
    world, same = get_world(f"{name}:4@0.75"), WORLDS[name](4, difficulty=0.75)
    assert len(world.obstacles) == len(same.obstacles)
    assert all(torch.equal(a.vertices, b.vertices) for a, b in zip(world.obstacles, same.obstacles, strict=True))
    assert get_world(f"{name}:4@0.75") is world
    assert len(get_world(f"{name}@0.75").obstacles) == len(WORLDS[name](0, difficulty=0.75).obstacles)


def seeded(seed: int) -> World:
    return World(f"seed {seed}", FLOOR)


def canyon(seed: int = 0, difficulty: float = 0.2) -> World:
    return World(f"canyon {seed} {difficulty:g}", FLOOR)


def slope(difficulty: float) -> World:
    return World(f"slope {difficulty:g}", FLOOR)


@pytest.mark.parametrize(
    ("part", "suffix", "expected"),
    [
        (seeded, "", "seed 0"),
        (seeded, ":3", "seed 3"),
        (canyon, "", "canyon 0 0.2"),
        (canyon, ":7", "canyon 7 0.2"),
        (canyon, "@0.9", "canyon 0 0.9"),
        (canyon, ":7@0.9", "canyon 7 0.9"),
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


@pytest.mark.parametrize(
    ("part", "suffix", "message"),
    [
        (seeded, ":1@0.3", "takes no difficulty, got 0.3"),
        (seeded(1), "@0.3", "takes no difficulty, got 0.3"),
        (seeded(1), ":0", "takes no seed, got 0"),
        (lambda: seeded(5), ":3", "takes no seed, got 3"),
        (slope, ":2@0.4", "takes no seed, got 2"),
        (lambda: "canyon", "", "must be a World or a function that returns one, got str"),
        (lambda seed: None, "", "must be a World or a function that returns one, got NoneType"),
        (FLOOR, "", "must be a World or a function that returns one, got Terrain"),
    ],
)
def test_what_a_registered_part_does_not_give(part, suffix, message):
    name = next(NEW_NAMES)
    register_world(name, part)
    with pytest.raises(ValueError, match=f"^world '{name}' {message}$"):
        get_world(name + suffix)


def test_worlds_by_import_path(tmp_path, monkeypatch):
    source = (
        "from rover_rl.worlds import Terrain, World\n"
        "def canyon(seed, difficulty=0.5):\n"
        "    return World(f'canyon-{seed}-{difficulty:g}', Terrain.flat((10, 10)))\n"
        "plain = World('plain', Terrain.flat((10, 10)))\n"
    )
    (tmp_path / "names_test_worlds.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    assert get_world("names_test_worlds:canyon:7@0.3").name == "canyon-7-0.3"
    assert get_world("names_test_worlds:canyon").name == "canyon-0-0.5"
    assert get_world("names_test_worlds:plain").name == "plain"
    register_world("by-path", "names_test_worlds:canyon")
    assert get_world("by-path:2@0.3").name == "canyon-2-0.3"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("maze", "^a world named 'maze' already exists; choose another name$"),
        ("registered:3", "^the name of a world must consist of letters"),
    ],
)
def test_names_that_cannot_be_registered(name, message):
    built_in = get_world("maze")
    with pytest.raises(ValueError, match=message):
        register_world(name, seeded)
    assert get_world("maze") is built_in


def test_get_world_returns_the_same_object_for_the_same_name():
    still, moving = (
        ("inspect", "moon", "maze", "rooms", "forest", "hills", "ramps"),
        ("plaza", "corridor", "crossing", "field", "yard"),
    )
    assert set(WORLDS) == {*still, *moving}
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
