"""Packed worlds that are kept on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rover_rl import Terrain, World, box
from rover_rl.sims.scenes.table import PackedScene
from rover_rl.worlds import get_world


def yard(side: float = 1.0) -> World:
    """A new world object with the same content for the same argument."""
    return World("yard", Terrain.flat((8, 8)), [box((0, 1, 0.5), (side, 1, 1), yaw=0.3), box((2, -1, 0.5), (1, 1, 1))])


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "rover_rl" / "scenes"


def assert_equal(one: PackedScene, other: PackedScene) -> None:
    assert np.array_equal(one.block, other.block)
    assert np.array_equal(one.record, other.record)


def test_an_equal_world_has_the_stored_scene(folder: Path) -> None:
    packed = PackedScene.stored(yard(), 0.5)
    assert_equal(packed, PackedScene.of(yard(), 0.5))
    assert_equal(packed, PackedScene.stored(yard(), 0.5))
    assert len(list(folder.rglob("*.npz"))) == 1


def test_a_damaged_file_is_replaced(folder: Path) -> None:
    packed = PackedScene.stored(get_world("moon"), 0.5)
    (file,) = folder.rglob("*.npz")
    file.write_bytes(b"damaged")
    assert_equal(packed, PackedScene.stored(get_world("moon"), 0.5))
    assert file.stat().st_size > 1000
