"""Pools of worlds that episodes draw from, and a thread that prepares worlds before they are needed."""

from __future__ import annotations

import threading
import weakref
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import suppress
from itertools import accumulate
from queue import Empty, SimpleQueue
from typing import TypeAlias, Union

from rover_rl.names import Name
from rover_rl.worlds import get_world
from rover_rl.worlds.world import World

KEPT_WORLDS = 1024
"""Number of worlds that a pool keeps, the last used ones, so that they are not generated again."""

WorldSource: TypeAlias = Union[str, World, "WorldPool", Sequence[str | World]]
"""What ``world_n`` takes: a world, a range of worlds, a pool, or a list of worlds and ranges."""
_Queue: TypeAlias = "SimpleQueue[tuple[int, Future[World]] | None]"


class WorldPool:
    """Worlds that episodes draw from, in a fixed order.

    A pool has one or more entries. An episode first draws an entry and then one of its worlds, both uniformly, so that
    ``["maze:*", "moon"]`` has as many episodes in mazes as on the moon.

    Args:
        *entries: each one a :class:`World`, the name of a world (``"maze"``, ``"maze:7"``), or a range of seeds:
            ``"maze:0-999"``, or ``"maze:*"`` for the 10,000 seeds from 0 to 9999. Seeds from 10,000 up are for
            evaluation. See :class:`~rover_rl.names.Name`.

    Attributes:
        entries: the arguments.
        sizes: number of worlds of each entry.
        shares: share of the episodes of each entry, equal ones unless they are set.

    Raises:
        ValueError: if there is no entry, or a range is not in order.

    Example:
        >>> pool = WorldPool("maze:0-9", "moon")
        >>> len(pool), pool.name(3), pool.name(10)
        (11, 'maze:3', 'moon')
    """

    def __init__(self, *entries: str | World) -> None:
        if not entries:
            raise ValueError("a pool needs at least one world, got none")
        self.entries = entries
        names = (Name.parse(entry) if isinstance(entry, str) else None for entry in entries)
        self._ranges = [name if name and name.is_range else None for name in names]
        self.sizes = tuple(1 if seeds is None else len(seeds) for seeds in self._ranges)
        self.shares = (1 / len(entries),) * len(entries)
        self._starts = (0, *accumulate(self.sizes))
        self._kept: OrderedDict[int, World] = OrderedDict()
        # The thread of WorldsAhead may generate worlds.
        self._lock = threading.Lock()

    @classmethod
    def of(cls, worlds: WorldSource) -> WorldPool:
        """Makes a pool. Returns a pool unchanged."""
        if isinstance(worlds, WorldPool):
            return worlds
        return cls(worlds) if isinstance(worlds, (str, World)) else cls(*worlds)

    @property
    def shares_of_worlds(self) -> list[float]:
        """Share of the episodes of each world: those of an entry have equal ones."""
        pairs = zip(self.shares, self.sizes, strict=True)
        return [share / size for share, size in pairs for _ in range(size)]

    @property
    def has_ranges(self) -> bool:
        return any(self._ranges)

    @property
    def kept(self) -> Container[int]:
        """Indices of the worlds that are in memory."""
        return self._kept.keys()

    def __len__(self) -> int:
        return self._starts[-1]

    def __reduce__(self) -> tuple[type[WorldPool], tuple[str | World, ...]]:
        return type(self), self.entries

    def name(self, index: int) -> str:
        """Returns the name of world ``index``, for :func:`~rover_rl.worlds.get_world`."""
        source = self.source(index)
        return source.name if isinstance(source, World) else source

    def source(self, index: int) -> str | World:
        """Returns world ``index`` as it was given: its name, which takes no work, or the world."""
        if not 0 <= index < len(self):
            raise IndexError(f"the pool has {len(self)} worlds, got index {index}")
        part = bisect_right(self._starts, index) - 1
        seeds = self._ranges[part]
        return self.entries[part] if seeds is None else str(seeds[index - self._starts[part]])

    def some(self) -> list[World]:
        """Returns the first, the middle and the last world of each entry, which tell what all are like."""
        ends = zip(self._starts, self.sizes, strict=False)
        return [self[index] for start, size in ends for index in sorted({start, start + size // 2, start + size - 1})]

    def __getitem__(self, index: int) -> World:
        world = self._kept.get(index) or get_world(self.source(index))
        with self._lock:
            self._kept[index] = world
            self._kept.move_to_end(index)
            if len(self._kept) > KEPT_WORLDS:
                self._kept.popitem(last=False)
        return world

    def __iter__(self) -> Iterator[World]:
        return (self[index] for index in range(len(self)))


def draws_worlds(worlds: WorldSource) -> bool:
    """Whether each episode draws its world: from a pool, or from a list with a range of seeds."""
    return isinstance(worlds, WorldPool) or WorldPool.of(worlds).has_ranges


class WorldsAhead:
    """Generates and prepares worlds of a pool in a thread, unless the caller needs them before it has begun.

    The thread and its caller share Python's interpreter lock: :meth:`pause` the thread except while the caller waits
    for what does not hold the lock, such as kernels.

    Args:
        pool: worlds.
        prepare: what to do with each world, besides generating it. It must be safe to call from another thread.
        limit: largest number of worlds that are requested and not taken. Of more, the first requested ones are dropped.
    """

    def __init__(self, pool: WorldPool, prepare: Callable[[World], object], limit: int) -> None:
        self._pool, self._limit = pool, limit
        self._requested: OrderedDict[int, Future[World]] = OrderedDict()
        self._queue: _Queue = SimpleQueue()
        self._go = threading.Event()
        self._go.set()
        # The thread holds no reference to this object, which therefore ends it when it is garbage.
        thread = threading.Thread(target=_work, args=(self._queue, self._go, pool, prepare), daemon=True)
        thread.start()
        self._finalizer = weakref.finalize(self, _end, self._queue, self._go, thread)

    def pause(self) -> None:
        """Lets the thread begin with no further world until :meth:`resume`."""
        self._go.clear()

    def resume(self) -> None:
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
        future = self._requested.pop(index, None)
        return self._pool[index] if future is None or future.cancel() else future.result()

    def close(self) -> None:
        """Ends the thread after the world that it is preparing. Idempotent."""
        for future in self._requested.values():
            future.cancel()
        self._requested.clear()
        self._finalizer()


def _work(queue: _Queue, go: threading.Event, pool: WorldPool, prepare: Callable[[World], object]) -> None:
    """Prepares the worlds of a queue, until ``None``, while ``go`` is set."""
    while (item := queue.get()) and go.wait():
        index, future = item
        if future.set_running_or_notify_cancel():
            try:
                world = pool[index]
                prepare(world)
            except BaseException as error:
                future.set_exception(error)
            else:
                future.set_result(world)


def _end(queue: _Queue, go: threading.Event, thread: threading.Thread) -> None:
    with suppress(Empty):
        while True:
            queue.get_nowait()
    queue.put(None)
    go.set()
    thread.join()
