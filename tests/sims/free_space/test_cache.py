"""Free space that is kept on disk."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch

from rover_rl import Terrain, World, box
from rover_rl.robots import get_robot
from rover_rl.sims.free_space import FreeSpace, free_space
from rover_rl.sims.free_space.space import load_free_space, store_free_space

ROBOT = get_robot("rover_zero")


def yard(side: float = 1.0, **settings) -> World:
    """A new world object with the same content for the same arguments."""
    obstacles = [box((0, 1, 0.5), (side, 1, 1)), box((2, -1, 0.5), (1, 1, 1))]
    return World("yard", Terrain.flat((8, 8)), obstacles, **settings)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "rover_rl" / "free_space"


def files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def assert_equal(one: FreeSpace, other: FreeSpace | None) -> None:
    assert other is not None
    for field in fields(FreeSpace):
        a, b = getattr(one, field.name), getattr(other, field.name)
        torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_an_equal_world_has_the_stored_free_space(folder: Path) -> None:
    space = free_space(yard(), ROBOT)
    assert len(files(folder)) == 1
    assert_equal(space, load_free_space(yard(), ROBOT))
    # What is stored is what is used.
    store_free_space(yard(), ROBOT, replace(space, goal_extremes=space.goal_extremes + 1))
    assert torch.equal(free_space(yard(), ROBOT).goal_extremes, space.goal_extremes + 1)


@pytest.mark.parametrize(
    "other",
    [
        yard(1.1),
        yard(spawn_range=((-2, 2), (-2, 2))),
        World("yard", Terrain.flat((8, 8), height=0.1), yard().obstacles),
        World("yard", Terrain.flat((8, 8))),
    ],
    ids=["obstacle", "area", "terrain", "no obstacles"],
)
def test_another_world_has_its_own(other: World) -> None:
    free_space(yard(), ROBOT)
    assert load_free_space(other, ROBOT) is None


def test_the_robot_is_known_by_its_description(tmp_path: Path) -> None:
    free_space(yard(), ROBOT)
    copy = tmp_path / "copy.urdf"
    copy.write_bytes(ROBOT.urdf.read_bytes())
    for same in (replace(ROBOT, name="twin"), replace(ROBOT, urdf=copy)):
        assert load_free_space(yard(), same) is not None
    copy.write_bytes(ROBOT.urdf.read_bytes() + b"<!-- changed -->")
    for other in (replace(ROBOT, radius=0.4), replace(ROBOT, urdf=copy, lidar_range=9.0)):
        assert load_free_space(yard(), other) is None


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: b"",
        lambda data: b"damaged",
        lambda data: data[:-100],
        lambda data: data[:50] + bytes([data[50] ^ 1]) + data[51:],
        lambda data: zlib.compress(b"\xff" * 1000),
        lambda data: zlib.compress(zlib.decompress(data).replace(b"<i8", b"|O8")),
        lambda data: zlib.compress(zlib.decompress(data).replace(b"[", b"{")),
    ],
    ids=["empty", "other", "cut", "bit", "size", "objects", "description"],
)
def test_a_damaged_file_is_replaced(folder: Path, damage: Callable[[bytes], bytes]) -> None:
    space = free_space(yard(), ROBOT)
    (file,) = files(folder)
    content = damage(file.read_bytes())
    assert content != file.read_bytes()
    file.write_bytes(content)
    assert_equal(space, free_space(yard(), ROBOT))
    assert_equal(space, load_free_space(yard(), ROBOT))


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "rover_rl").write_text("a file where the folder would be")
    space = free_space(yard(), ROBOT)
    assert load_free_space(yard(), ROBOT) is None
    assert isinstance(space, FreeSpace)
