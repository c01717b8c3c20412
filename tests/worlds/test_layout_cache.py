"""Generated worlds that are kept on disk."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest
import torch

from rover_rl import Terrain, World, register_world
from rover_rl.worlds import WORLDS, WorldName, get_world, layout_cache
from rover_rl.worlds.layout_cache import stored_layout
from rover_rl.worlds.obstacles import groups_of

pytestmark = pytest.mark.usefixtures("own_registries")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "rover_rl" / "layouts"


MAZE = WorldName("maze", 3)


def generated() -> World:
    return WORLDS["maze"](3)


def never() -> World:
    raise AssertionError("the world is on disk")


def assert_equal(one: World, other: World) -> None:
    """Checks that two worlds are equal to the last bit."""
    for field in fields(World):
        if field.name not in ("terrain", "obstacles"):
            # The text tells lists from tuples, and 1 from 1.0.
            assert repr(getattr(one, field.name)) == repr(getattr(other, field.name))
    assert (one.terrain.cell, one.terrain.origin) == (other.terrain.cell, other.terrain.origin)
    assert torch.equal(one.terrain.heights, other.terrain.heights)
    assert len(one.obstacles) == len(other.obstacles)
    for a, b in zip(one.obstacles, other.obstacles, strict=True):
        for part in ("vertices", "planes", "faces", "footprint"):
            assert getattr(a, part).numpy().tobytes() == getattr(b, part).numpy().tobytes()
    assert len(groups_of(one.obstacles)) == len(groups_of(other.obstacles))


@pytest.mark.parametrize("name", [name for name in WORLDS if not get_world(name).movers])
def test_a_stored_world_equals_the_generated_one(name: str) -> None:
    key = WorldName(name, 3, 1.0)
    world = stored_layout(key, lambda: WORLDS[name](3, difficulty=1.0))
    assert_equal(world, stored_layout(key, never))
    assert_equal(world, WORLDS[name](3, difficulty=1.0))


def test_a_world_is_found_by_its_whole_name() -> None:
    stored_layout(MAZE, generated)
    for name in (WorldName("maze", 4), WorldName("rooms", 3), WorldName("maze", 3, 0.2)):
        with pytest.raises(AssertionError, match="on disk"):
            stored_layout(name, never)


def test_another_version_of_numpy_generates_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    stored_layout(MAZE, generated)
    monkeypatch.setattr(layout_cache.np, "__version__", "99.0")
    with pytest.raises(AssertionError, match="on disk"):
        stored_layout(MAZE, never)


def test_a_damaged_file_is_replaced(folder: Path) -> None:
    world = stored_layout(MAZE, generated)
    (file,) = folder.rglob("*.bin")
    file.write_bytes(file.read_bytes()[:-10])
    assert_equal(world, stored_layout(MAZE, generated))
    assert_equal(world, stored_layout(MAZE, never))


def test_only_built_in_worlds_are_stored(folder: Path) -> None:
    made: list[int] = []

    def canyon(seed: int) -> World:
        made.append(seed)
        return World("canyon", Terrain.flat((8, 8)))

    register_world("stored-canyon", canyon)
    get_world("stored-canyon:1")
    assert made == [1]
    assert not folder.exists()
    get_world("maze:654321")
    assert len(list(folder.rglob("*.bin"))) == 1
