"""Free space that is kept on disk."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch

from rover_rl import Terrain, World, box
from rover_rl.robots import get_robot
from rover_rl.sims.free_space import FreeSpace, free_space, space

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


def assert_equal(one: FreeSpace, other: FreeSpace) -> None:
    for field in fields(FreeSpace):
        torch.testing.assert_close(getattr(one, field.name), getattr(other, field.name), rtol=0, atol=0)


def test_an_equal_world_has_the_stored_free_space(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = free_space(yard(), ROBOT)
    monkeypatch.setattr(space, "_compute", None)
    assert_equal(first, free_space(yard(), replace(ROBOT, name="twin")))
    assert len(files(folder)) == 1


def test_another_world_or_robot_has_its_own(folder: Path) -> None:
    others = [yard(1.1), yard(spawn_range=((-2, 2), (-2, 2))), World("yard", Terrain.flat((8, 8)))]
    for count, world in enumerate([yard(), *others], 1):
        free_space(world, ROBOT)
        assert len(files(folder)) == count
    for count, robot in enumerate((replace(ROBOT, radius=0.4), replace(ROBOT, lidar_range=9.0)), 5):
        free_space(yard(), robot)
        assert len(files(folder)) == count


@pytest.mark.parametrize("damage", [lambda data: b"damaged", lambda data: data[:-100]], ids=["other", "cut"])
def test_a_damaged_file_is_replaced(folder: Path, damage: Callable[[bytes], bytes]) -> None:
    first = free_space(yard(), ROBOT)
    (file,) = files(folder)
    file.write_bytes(damage(file.read_bytes()))
    assert_equal(first, free_space(yard(), ROBOT))
    assert_equal(first, free_space(yard(), ROBOT))


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "rover_rl").write_text("a file where the folder would be")
    assert isinstance(free_space(yard(), ROBOT), FreeSpace)
