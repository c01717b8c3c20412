"""Pools of worlds, and names of ranges."""

from __future__ import annotations

from itertools import pairwise

import pytest

from rover_rl import Terrain, World
from rover_rl.worlds import get_world
from rover_rl.worlds.names import WorldRange, check_training_seed, unseen
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


def test_a_star_stands_for_the_seeds_for_training() -> None:
    pool = WorldPool("maze:*")
    assert (len(pool), pool.name(0), pool.name(9999)) == (10_000, "maze:0", "maze:9999")


def test_the_difficulties_of_a_range_are_spread_evenly() -> None:
    seeds = WorldRange.parse("maze:100-199@0.2-0.6")
    assert seeds is not None
    levels = sorted(float(seeds.name(number).partition("@")[2]) for number in range(100))
    assert 0.2 <= levels[0] < 0.22
    assert 0.58 < levels[-1] <= 0.6
    assert max(b - a for a, b in pairwise(levels)) < 0.02


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("maze:9-3", "the ends of 'maze:9-3' must be in order, as in 'maze:0-99@0.2-0.8'"),
        ("maze:*@0.8-0.2", "the ends of 'maze:.*@0.8-0.2' must be in order"),
        ("maze:*@2", "the difficulty of world 'maze:.*@2' must be a number from 0 to 1, got '2'"),
        ("maze:*@0.1-x", "the difficulty of world 'maze:.*' must be a number from 0 to 1, got '0.1-x'"),
    ],
)
def test_a_range_out_of_order_raises(entry: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WorldPool(entry)


def test_an_empty_pool_raises() -> None:
    with pytest.raises(ValueError, match="a pool needs at least one world, got none"):
        WorldPool()


def test_a_range_is_no_world() -> None:
    with pytest.raises(ValueError, match="'maze:2-9' names 8 worlds; name one of them, such as 'maze:2'"):
        get_world("maze:2-9")


@pytest.mark.parametrize(
    ("trained", "expected"),
    [
        ("maze:*", "maze:10000"),
        ("maze:0-99@0.5", "maze:10000@0.5"),
        ("maze:0-20000", "maze:20001"),
        ("maze:7", "maze:7"),
        ("moon", "moon"),
    ],
)
def test_a_policy_is_tested_in_a_world_that_was_not_in_its_training(trained: str, expected: str) -> None:
    assert unseen(trained) == expected


@pytest.mark.parametrize("name", ["maze:10000", "maze:0-10000", "maze:12345@0.5"])
def test_seeds_for_evaluation_are_refused_for_training(name: str) -> None:
    with pytest.raises(ValueError, match=r"seeds from 10000 up are for evaluation.*'maze:\*'.*got 'maze:"):
        check_training_seed(name)


@pytest.mark.parametrize("name", ["maze", "maze:9999", "maze:*", "maze:0-9999@0.5", "my_package:canyon"])
def test_other_seeds_are_for_training(name: str) -> None:
    check_training_seed(name)
