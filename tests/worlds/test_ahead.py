"""Preparation of worlds in a thread."""

from __future__ import annotations

import gc
import threading

import pytest

from rover_rl.worlds import World
from rover_rl.worlds.pool import WorldPool, WorldsAhead


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
        for _ in range(count):
            assert self.done.acquire(timeout=10)


@pytest.fixture
def prepared() -> Prepared:
    return Prepared()


def test_a_requested_world_is_prepared_in_the_thread(prepared: Prepared) -> None:
    prepared.go.set()
    pool = WorldPool("ramps:0-9")
    ahead = WorldsAhead(pool, prepared, limit=5)
    ahead.request([4, 7])
    prepared.wait(2)
    assert ahead[7] is pool[7]
    assert ahead[4] is pool[4]
    assert prepared.worlds == [pool[4], pool[7]]
    assert threading.current_thread() not in prepared.threads
    ahead.close()


def test_a_world_that_is_needed_before_its_turn_is_generated_at_once(prepared: Prepared) -> None:
    pool = WorldPool("ramps:0-9")
    ahead = WorldsAhead(pool, prepared, limit=5)
    ahead.request([1, 2, 3])
    assert prepared.started.wait(10)
    # The thread is busy with the first world, so that these calls would not return if they waited for it.
    assert [ahead[index] for index in (2, 8)] == [pool[2], pool[8]]
    prepared.go.set()
    assert [ahead[index] for index in (3, 1)] == [pool[3], pool[1]]
    assert pool[2] not in prepared.worlds
    ahead.close()


def test_of_too_many_worlds_the_first_requested_are_dropped(prepared: Prepared) -> None:
    pool = WorldPool("ramps:0-9")
    ahead = WorldsAhead(pool, prepared, limit=2)
    ahead.request([0])
    assert prepared.started.wait(10)
    ahead.request([1, 2, 3])
    prepared.go.set()
    prepared.wait(3)
    assert prepared.worlds == [pool[0], pool[2], pool[3]]
    ahead.close()


def test_a_world_that_cannot_be_prepared_raises_where_it_is_needed(prepared: Prepared) -> None:
    def fail(world: World) -> None:
        prepared(world)
        raise ValueError("no free cell")

    ahead = WorldsAhead(WorldPool("ramps:0-9"), fail, limit=5)
    prepared.go.set()
    ahead.request([1, 2])
    # The thread goes on after an error.
    prepared.wait(2)
    for index in (2, 1):
        with pytest.raises(ValueError, match="no free cell"):
            ahead[index]
    ahead.close()


def test_a_paused_thread_begins_with_no_world(prepared: Prepared) -> None:
    prepared.go.set()
    pool = WorldPool("ramps:0-9")
    ahead = WorldsAhead(pool, prepared, limit=5)
    ahead.pause()
    ahead.request([1, 2])
    assert ahead[1] is pool[1]
    assert not prepared.started.wait(0.05)
    ahead.resume()
    prepared.wait(1)
    assert prepared.worlds == [pool[2]]
    ahead.pause()
    ahead.close()


@pytest.mark.parametrize("way", ["close", "garbage"])
def test_the_thread_ends(prepared: Prepared, way: str) -> None:
    prepared.go.set()
    ahead = WorldsAhead(WorldPool("ramps:0-9"), prepared, limit=5)
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
