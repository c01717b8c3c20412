"""Registration of custom worlds. Names are unique, because get_world caches worlds by name."""

from __future__ import annotations

import sys

import pytest

from rover_rl.sims.worlds import Terrain, World, get_world, register_world, world_names

pytestmark = pytest.mark.usefixtures("own_registries")


def make_world(seed: int) -> World:
    return World(f"world-{seed}", Terrain.flat((10, 10)))


def test_a_registered_function_with_a_seed():
    register_world("registered-seeded", make_world)
    assert "registered-seeded" in world_names()
    assert get_world("registered-seeded").name == "world-0"
    assert get_world("registered-seeded:3").name == "world-3"
    assert get_world("registered-seeded:3") is get_world("registered-seeded:3")


def test_a_registered_function_without_a_seed():
    register_world("registered-unseeded", lambda: make_world(5))
    assert get_world("registered-unseeded").name == "world-5"
    assert get_world("registered-unseeded") is get_world("registered-unseeded")
    with pytest.raises(ValueError, match="^world 'registered-unseeded' takes no seed, got 3$"):
        get_world("registered-unseeded:3")


def test_a_registered_world_object():
    world = make_world(1)
    register_world("registered-object", world)
    assert get_world("registered-object") is world
    with pytest.raises(ValueError, match="^world 'registered-object' takes no seed, got 0$"):
        get_world("registered-object:0")


def test_worlds_by_import_path(tmp_path, monkeypatch):
    source = (
        "from rover_rl.sims.worlds import Terrain, World\n"
        "def canyon(seed):\n    return World(f'canyon-{seed}', Terrain.flat((10, 10)))\n"
        "plain = World('plain', Terrain.flat((10, 10)))\n"
    )
    (tmp_path / "registration_test_worlds.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    assert get_world("registration_test_worlds:canyon").name == "canyon-0"
    assert get_world("registration_test_worlds:canyon:7").name == "canyon-7"
    assert get_world("registration_test_worlds:plain") is sys.modules["registration_test_worlds"].plain
    register_world("registered-path", "registration_test_worlds:canyon")
    assert get_world("registered-path:2").name == "canyon-2"


@pytest.mark.parametrize(
    ("name", "part", "kind"),
    [
        ("registered-text", lambda: "canyon", "str"),
        ("registered-none", lambda seed: None, "NoneType"),
        ("registered-terrain", Terrain.flat((10, 10)), "Terrain"),
    ],
)
def test_anything_else_than_a_world_raises(name, part, kind):
    register_world(name, part)
    with pytest.raises(
        ValueError, match=f"^world '{name}' must be a World or a function that returns one, got {kind}$"
    ):
        get_world(name)


@pytest.mark.parametrize("name", ["maze", "moon", "inspect"])
def test_names_of_built_in_worlds_are_taken(name):
    built_in = get_world(name)
    with pytest.raises(ValueError, match=f"^a world named '{name}' already exists; choose another name$"):
        register_world(name, make_world)
    assert get_world(name) is built_in


def test_a_name_with_a_colon_raises():
    with pytest.raises(ValueError, match="^the name of a world must consist of letters"):
        register_world("registered:3", make_world)
