"""Preparation of the worlds of a pool before they are needed, in a thread."""

from __future__ import annotations

import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from queue import SimpleQueue
from typing import TypeAlias

from rover_rl.worlds.pool import WorldPool
from rover_rl.worlds.world import World

_Queue: TypeAlias = "SimpleQueue[tuple[int, Future[World]] | None]"


class WorldsAhead:
    """Prepares worlds of a pool in a thread.

    A world is generated and prepared once: by the caller if it is needed before the thread has begun with it. The
    thread and its caller share Python's interpreter lock: :meth:`pause` the thread except while the caller waits for
    what does not hold the lock, such as kernels.

    Args:
        pool: worlds.
        prepare: what to do with each world, besides generating it. It must be safe to call from another thread.
        limit: largest number of worlds that are requested and not taken. Of more, the first requested ones are dropped.
    """

    def __init__(self, pool: WorldPool, prepare: Callable[[World], object], limit: int) -> None:
        self._pool, self._limit = pool, limit
        self._requested: OrderedDict[int, Future[World]] = OrderedDict()
        self._queue: _Queue = SimpleQueue()
        self._go, stop = threading.Event(), threading.Event()
        self._go.set()
        # The thread holds no reference to this object, which therefore ends it when it is garbage.
        thread = threading.Thread(target=_work, args=(self._queue, self._go, stop, pool, prepare), daemon=True)
        thread.start()
        self._finalizer = weakref.finalize(self, _end, self._queue, self._go, stop, thread)

    def pause(self) -> None:
        """Lets the thread begin with no further world until :meth:`resume`."""
        self._go.clear()

    def resume(self) -> None:
        """Lets the thread go on."""
        self._go.set()

    def request(self, indices: Iterable[int]) -> None:
        """Adds worlds to those that the thread prepares. Returns immediately."""
        for index in indices:
            if index in self._requested:
                self._requested.move_to_end(index)
            elif index not in self._pool.kept:
                future: Future[World] = Future()
                self._requested[index] = future
                self._queue.put((index, future))
        while len(self._requested) > self._limit:
            self._requested.popitem(last=False)[1].cancel()

    def __getitem__(self, index: int) -> World:
        """Returns world ``index``. Waits for it if the thread is preparing it, and raises what that raised."""
        future = self._requested.pop(index, None)
        return self._pool[index] if future is None or future.cancel() else future.result()

    def close(self) -> None:
        """Ends the thread after the world that it is preparing. Idempotent."""
        self._finalizer()
        self._requested.clear()


def _work(
    queue: _Queue, go: threading.Event, stop: threading.Event, pool: WorldPool, prepare: Callable[[World], object]
) -> None:
    """Prepares the worlds of a queue while ``go`` is set, until ``stop`` is set."""
    while (item := queue.get()) and go.wait() and not stop.is_set():
        index, future = item
        if future.set_running_or_notify_cancel():
            try:
                world = pool[index]
                prepare(world)
            except BaseException as error:
                future.set_exception(error)
            else:
                future.set_result(world)


def _end(queue: _Queue, go: threading.Event, stop: threading.Event, thread: threading.Thread) -> None:
    stop.set()
    go.set()
    queue.put(None)
    thread.join()
