"""Names of worlds: NAME[:SEED][@DIFFICULTY]."""

from __future__ import annotations

import pytest
import torch

from rover_rl.sims.worlds import WORLDS, Terrain, World, WorldName, get_world, register_world

pytestmark = pytest.mark.usefixtures("own_registries")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("maze", WorldName("maze")),
        ("maze:12", WorldName("maze", 12)),
        ("maze@0.3", WorldName("maze", None, 0.3)),
        ("maze:12@0.3", WorldName("maze", 12, 0.3)),
        ("forest:7@1", WorldName("forest", 7, 1.0)),
        ("forest:7@.25", WorldName("forest", 7, 0.25)),
        ("my_package.worlds:canyon", WorldName("my_package.worlds:canyon")),
        ("my_package.worlds:canyon:7@0", WorldName("my_package.worlds:canyon", 7, 0.0)),
        ("maze:x", WorldName("maze:x")),
    ],
)
def test_parsed_names(text, name):
    assert WorldName.parse(text) == name


@pytest.mark.parametrize(
    "level", ["", "x", "1.01", "-0.1", "2", "nan", "inf", "1e-1", "0,5", "0.5@0.5", " 0.5", "²", "1."]
)
def test_a_malformed_difficulty_raises(level):
    with pytest.raises(ValueError) as error:
        get_world(f"maze:3@{level}")
    assert str(error.value) == f"the difficulty of world 'maze:3@{level}' must be a number from 0 to 1, got {level!r}"


def test_the_seed_stays_before_the_difficulty():
    with pytest.raises(ValueError, match="^unknown world 'maze:x', perhaps 'maze'; use one of"):
        get_world("maze:x@0.5")
    with pytest.raises(ValueError, match="must be a number from 0 to 1, got '0.5:7'$"):
        get_world("maze@0.5:7")


@pytest.mark.parametrize("name", ["maze", "forest"])
def test_the_name_gives_the_layout_of_the_function(name):
    world, same = get_world(f"{name}:4@0.75"), WORLDS[name](4, difficulty=0.75)
    assert len(world.obstacles) == len(same.obstacles)
    assert all(torch.equal(a.vertices, b.vertices) for a, b in zip(world.obstacles, same.obstacles, strict=True))
    assert get_world(f"{name}:4@0.75") is world
    assert len(get_world(f"{name}@0.75").obstacles) == len(WORLDS[name](0, difficulty=0.75).obstacles)


def test_functions_with_a_difficulty():
    def canyon(seed: int = 0, difficulty: float = 0.2) -> World:
        return World(f"canyon-{seed}-{difficulty:g}", Terrain.flat((10, 10)))

    register_world("named-canyon", canyon)
    assert get_world("named-canyon").name == "canyon-0-0.2"
    assert get_world("named-canyon:7").name == "canyon-7-0.2"
    assert get_world("named-canyon@0.9").name == "canyon-0-0.9"
    assert get_world("named-canyon:7@0.9").name == "canyon-7-0.9"


def test_parts_without_a_difficulty_refuse_one():
    register_world("named-seeded", lambda seed: World("seeded", Terrain.flat((10, 10))))
    register_world("named-plain", World("plain", Terrain.flat((10, 10))))
    with pytest.raises(ValueError, match="^world 'named-seeded' takes no difficulty, got 0.3$"):
        get_world("named-seeded:1@0.3")
    with pytest.raises(ValueError, match="^world 'named-plain' takes no difficulty, got 0.3$"):
        get_world("named-plain@0.3")


def test_functions_with_a_difficulty_alone():
    def slope(difficulty: float) -> World:
        return World(f"slope-{difficulty:g}", Terrain.flat((10, 10)))

    register_world("named-slope", slope)
    assert get_world("named-slope@0.4").name == "slope-0.4"
    with pytest.raises(ValueError, match="^world 'named-slope' takes no seed, got 2$"):
        get_world("named-slope:2@0.4")


def test_worlds_by_import_path(tmp_path, monkeypatch):
    source = (
        "from rover_rl.sims.worlds import Terrain, World\n"
        "def canyon(seed, difficulty=0.5):\n"
        "    return World(f'canyon-{seed}-{difficulty:g}', Terrain.flat((10, 10)))\n"
    )
    (tmp_path / "names_test_worlds.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    assert get_world("names_test_worlds:canyon:7@0.3").name == "canyon-7-0.3"
    assert get_world("names_test_worlds:canyon@0.3").name == "canyon-0-0.3"
