"""Pools of worlds that episodes draw from."""

from __future__ import annotations

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Container, Iterator, Sequence
from itertools import accumulate
from threading import Lock
from typing import TypeAlias, Union

from rover_rl.worlds import get_world
from rover_rl.worlds.names import WorldRange
from rover_rl.worlds.world import World

KEPT_WORLDS = 1024
"""Number of worlds that a pool keeps, the last used ones, so that they are not generated again."""

WorldSource: TypeAlias = Union[str, World, "WorldPool", Sequence[str | World]]
"""What ``world_n`` takes: a world, a range of worlds, a pool, or a list of worlds and ranges."""


class WorldPool:
    """Worlds that episodes draw from, in a fixed order.

    A pool has one or more entries. An episode first draws an entry and then one of its worlds, both uniformly, so that
    ``["maze:*", "moon"]`` has as many episodes in mazes as on the moon.

    Args:
        *entries: each one a :class:`World`, the name of a world (``"maze"``, ``"maze:7"``), or a range of seeds:
            ``"maze:0-999"``, or ``"maze:*"`` for the 10,000 seeds from 0 to 9999. Seeds from 10,000 up are for
            evaluation. A difficulty, or a range of difficulties, follows after ``@``, as in ``"maze:*@0.2-0.8"``: see
            :class:`~rover_rl.worlds.names.WorldRange`.

    Attributes:
        entries: the arguments.
        sizes: number of worlds of each entry.

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
        self._ranges = [WorldRange.parse(entry) if isinstance(entry, str) else None for entry in entries]
        self.sizes = tuple(1 if seeds is None else len(seeds) for seeds in self._ranges)
        self._starts = (0, *accumulate(self.sizes))
        self._kept: OrderedDict[int, World] = OrderedDict()
        # A thread may generate worlds: see rover_rl.worlds.ahead.
        self._lock = Lock()

    @classmethod
    def of(cls, worlds: WorldSource) -> WorldPool:
        """Returns the pool of one world or range, or of a list of them. Returns a pool unchanged."""
        if isinstance(worlds, WorldPool):
            return worlds
        return cls(worlds) if isinstance(worlds, (str, World)) else cls(*worlds)

    @property
    def has_ranges(self) -> bool:
        """Whether an entry is a range of seeds."""
        return any(self._ranges)

    @property
    def kept(self) -> Container[int]:
        """Indices of the worlds that are in memory."""
        return self._kept.keys()

    def __len__(self) -> int:
        """Number of worlds."""
        return self._starts[-1]

    def __reduce__(self) -> tuple[type[WorldPool], tuple[str | World, ...]]:
        """Pickles the entries without the worlds that are kept."""
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
        return self.entries[part] if seeds is None else seeds.name(index - self._starts[part])

    def __getitem__(self, index: int) -> World:
        """Returns world ``index``."""
        with self._lock:
            world = self._kept.get(index)
        if world is None:
            world = get_world(self.source(index))
        with self._lock:
            self._kept[index] = world
            self._kept.move_to_end(index)
            if len(self._kept) > KEPT_WORLDS:
                self._kept.popitem(last=False)
        return world

    def __iter__(self) -> Iterator[World]:
        """Iterates over all worlds."""
        return (self[index] for index in range(len(self)))


def draws_worlds(worlds: WorldSource) -> bool:
    """Whether each episode draws its world: from a pool, or from a list with a range of seeds."""
    return isinstance(worlds, WorldPool) or WorldPool.of(worlds).has_ranges
