"""Worlds of the rows of a batch, and their slots."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rover_rl import Terrain, World
from rover_rl.worlds.table import WorldTable

WORLDS = [World(f"world {k}", Terrain.flat((4, 4))) for k in range(6)]


def table_of(*numbers: int, spare: int = 0) -> WorldTable:
    return WorldTable([WORLDS[k] for k in numbers], spare=spare)


def move(table: WorldTable, rows: list[int], *numbers: int) -> None:
    table.assign(torch.tensor(rows), [WORLDS[k] for k in numbers])


@given(
    first=st.lists(st.integers(0, 5), min_size=4, max_size=4),
    moves=st.lists(st.tuples(st.integers(0, 3), st.integers(0, 5)), max_size=30),
    spare=st.integers(0, 3),
)
def test_every_row_has_the_slot_of_its_world(first: list[int], moves: list[tuple[int, int]], spare: int) -> None:
    table = table_of(*first, spare=spare)
    expected = list(first)
    # What a follower keeps: the world that entered each slot last.
    entered = table.follow()
    copied = entered()
    for row, world in moves:
        move(table, [row], world)
        copied |= entered()
        expected[row] = world
        assert [copied[slot] for slot in table.slots.tolist()] == [WORLDS[k] for k in expected]
        assert list(table) == [WORLDS[k] for k in expected]
        assert all(slot < table.capacity for slot in copied)


def test_a_world_stays_in_its_slot_while_there_is_room() -> None:
    table = table_of(0, 0, spare=1)
    entered = table.follow()
    assert entered() == {0: WORLDS[0]}
    move(table, [0, 1], 1, 1)
    assert entered() == {1: WORLDS[1]}
    move(table, [0], 0)
    assert entered() == {}
    # The world without rows that was left first makes room.
    move(table, [0, 1], 2, 2)
    assert entered() == {2: WORLDS[2]}
    move(table, [0, 1], 3, 3)
    assert entered() == {0: WORLDS[3]}


def test_each_follower_is_told_of_all_worlds_once() -> None:
    table = table_of(0, 1)
    first = table.follow()
    assert first() == {0: WORLDS[0], 1: WORLDS[1]}
    move(table, [0], 2)
    # A slot that has changed twice is told once.
    move(table, [1], 3)
    move(table, [0, 1], 4, 5)
    late = table.follow()
    told = late()
    assert [told[slot] for slot in table.slots.tolist()] == [WORLDS[4], WORLDS[5]]
    assert set(first().items()) <= set(told.items())
    assert (first(), late()) == ({}, {})


def test_rows_enter_worlds_that_are_held_by_their_slots_alone() -> None:
    table = table_of(0, 1, 0)
    entered = table.follow()
    entered()
    slots = table.hold([WORLDS[2], WORLDS[0], WORLDS[1]])
    assert entered() == {2: WORLDS[2]}
    table.enter(slots[torch.tensor([1, 0, 2])])
    assert list(table) == [WORLDS[0], WORLDS[2], WORLDS[1]]
    assert entered() == {}


def test_a_table_holds_no_more_worlds_than_it_has_slots() -> None:
    with pytest.raises(ValueError, match="a table of 2 slots cannot hold more worlds"):
        table_of(0).hold(WORLDS)
