"""Pools of worlds, and their preparation in a thread."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable

import pytest

from rover_rl import Terrain, World
from rover_rl.worlds import get_world
from rover_rl.worlds.pool import WorldPool, WorldsAhead

YARD = World("yard", Terrain.flat((8, 8)))
ERRORS: dict[str, Callable[[], object]] = {
    "the pool has 2 worlds, got index -1": lambda: WorldPool("maze", "moon")[-1],
    "the pool has 2 worlds, got index 2": lambda: WorldPool("maze", "moon")[2],
    "a pool needs at least one world, got none": WorldPool,
    "'maze:2-9' names 8 worlds; name one of them, such as 'maze:2'": lambda: get_world("maze:2-9"),
}


def test_a_pool_has_the_worlds_of_its_entries_in_order() -> None:
    pool = WorldPool("maze:3-5", YARD, "moon", "forest:7-8@0.2")
    names = ["maze:3", "maze:4", "maze:5", "yard", "moon", "forest:7@0.2", "forest:8@0.2"]
    assert [pool.name(index) for index in range(len(pool))] == names
    assert pool[3] is YARD
    assert pool[1] is get_world("maze:4")
    assert pool.has_ranges


@pytest.mark.parametrize("message", ERRORS)
def test_wrong_entries_and_indices_raise(message: str) -> None:
    with pytest.raises((ValueError, IndexError), match=message):
        ERRORS[message]()


class Prepared:
    """Records the worlds that are prepared. The thread waits until ``go`` is set."""

    def __init__(self) -> None:
        self.worlds: list[World] = []
        self.threads: set[threading.Thread] = set()
        self.started, self.go, self.done = threading.Event(), threading.Event(), threading.Semaphore(0)

    def __call__(self, world: World) -> None:
        self.started.set()
        self.go.wait(10)
        self.worlds.append(world)
        self.threads.add(threading.current_thread())
        self.done.release()

    def wait(self, count: int) -> None:
        """Waits until ``count`` more worlds are prepared."""
        assert all(self.done.acquire(timeout=10) for _ in range(count))


@pytest.fixture
def prepared() -> Prepared:
    return Prepared()


@pytest.fixture
def pool() -> WorldPool:
    return WorldPool("rooms:0-9")


def test_a_requested_world_is_prepared_in_the_thread_unless_it_is_paused(prepared: Prepared, pool: WorldPool) -> None:
    prepared.go.set()
    ahead = WorldsAhead(pool, prepared, limit=5)
    ahead.request([4, 7])
    prepared.wait(2)
    assert (ahead[7], ahead[4]) == (pool[7], pool[4])
    assert prepared.worlds == [pool[4], pool[7]]
    assert threading.current_thread() not in prepared.threads
    ahead.pause()
    prepared.started.clear()
    ahead.request([1, 2])
    assert ahead[1] is pool[1]
    assert not prepared.started.wait(0.05)
    ahead.resume()
    prepared.wait(1)
    assert prepared.worlds[2:] == [pool[2]]
    ahead.pause()
    ahead.close()


def test_a_world_that_is_needed_before_its_turn_is_generated_at_once(prepared: Prepared, pool: WorldPool) -> None:
    ahead = WorldsAhead(pool, prepared, limit=5)
    ahead.request([1, 2, 3])
    assert prepared.started.wait(10)
    # The thread is busy with the first world, so that these calls would not return if they waited for it.
    assert [ahead[index] for index in (2, 8)] == [pool[2], pool[8]]
    prepared.go.set()
    assert [ahead[index] for index in (3, 1)] == [pool[3], pool[1]]
    assert pool[2] not in prepared.worlds
    ahead.close()


def test_of_too_many_worlds_the_first_requested_are_dropped(prepared: Prepared, pool: WorldPool) -> None:
    ahead = WorldsAhead(pool, prepared, limit=2)
    ahead.request([0])
    assert prepared.started.wait(10)
    ahead.request([1, 2, 3])
    prepared.go.set()
    prepared.wait(3)
    assert prepared.worlds == [pool[0], pool[2], pool[3]]
    ahead.close()


def test_a_world_that_cannot_be_prepared_raises_where_it_is_needed(prepared: Prepared, pool: WorldPool) -> None:
    def fail(world: World) -> None:
        prepared(world)
        raise ValueError("no free cell")

    ahead = WorldsAhead(pool, fail, limit=5)
    prepared.go.set()
    ahead.request([1, 2])
    # The thread goes on after an error.
    prepared.wait(2)
    for index in (2, 1):
        with pytest.raises(ValueError, match="no free cell"):
            ahead[index]
    ahead.close()


@pytest.mark.parametrize("way", ["close", "garbage"])
def test_the_thread_ends(prepared: Prepared, pool: WorldPool, way: str) -> None:
    prepared.go.set()
    ahead = WorldsAhead(pool, prepared, limit=5)
    ahead.request([0])
    prepared.wait(1)
    (thread,) = prepared.threads
    assert thread.is_alive()
    if way == "close":
        ahead.close()
        ahead.close()
    del ahead
    gc.collect()
    assert not thread.is_alive()
