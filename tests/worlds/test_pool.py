"""Pools of worlds."""

from __future__ import annotations

import pytest

from rover_rl import Terrain, World
from rover_rl.worlds import get_world
from rover_rl.worlds.pool import WorldPool

YARD = World("yard", Terrain.flat((8, 8)))


def test_a_pool_has_the_worlds_of_its_entries_in_order() -> None:
    pool = WorldPool("maze:3-5", YARD, "moon", "forest:7-8@0.2")
    assert len(pool) == 7
    names = ["maze:3", "maze:4", "maze:5", "yard", "moon", "forest:7@0.2", "forest:8@0.2"]
    assert [pool.name(index) for index in range(7)] == names
    assert pool[3] is YARD
    assert pool[1] is get_world("maze:4")
    assert pool.has_ranges


@pytest.mark.parametrize("index", [-1, 2])
def test_an_index_out_of_range_raises(index: int) -> None:
    with pytest.raises(IndexError, match=f"the pool has 2 worlds, got index {index}"):
        WorldPool("maze", "moon")[index]


def test_an_empty_pool_raises() -> None:
    with pytest.raises(ValueError, match="a pool needs at least one world, got none"):
        WorldPool()


def test_a_range_is_no_world() -> None:
    with pytest.raises(ValueError, match="'maze:2-9' names 8 worlds; name one of them, such as 'maze:2'"):
        get_world("maze:2-9")
