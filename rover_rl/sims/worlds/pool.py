"""Pools of worlds that episodes draw from."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import TypeAlias, Union

from rover_rl.sims.worlds import get_world
from rover_rl.sims.worlds.world import World

TRAINING_SEEDS = 10_000
"""Number of seeds for training, from 0. By convention, higher seeds are for evaluation."""

KEPT_WORLDS = 2048
"""Number of worlds that a pool keeps, the last used ones, so that they are not generated again."""

WorldSource: TypeAlias = Union[str, World, "WorldPool", Sequence[str | World]]
"""What ``world_n`` takes: a world, a range of worlds, a pool, or a list of worlds and ranges."""

_RANGE = re.compile(r"(?P<name>.+):(?:\*|(?P<first>\d+)-(?P<last>\d+))(?P<difficulty>@.*)?")
_DIFFICULTIES = re.compile(r"@(?P<low>[\d.]+)-(?P<high>[\d.]+)")
_GOLDEN_RATIO = (5**0.5 - 1) / 2


class WorldPool:
    """Worlds that episodes draw from, in a fixed order.

    A pool has one or more entries. An episode first draws an entry and then one of its worlds, both uniformly, so that
    ``["maze:*", "moon"]`` has as many episodes in mazes as on the moon.

    Args:
        *entries: each one a :class:`World`, the name of a world (``"maze"``, ``"maze:7"``), or a range of seeds:
            ``"maze:0-999"``, or ``"maze:*"`` for the 10,000 seeds from 0 to 9999. Seeds from 10,000 up are for
            evaluation. A difficulty follows after ``@``; from a range of difficulties, as in ``"maze:*@0.2-0.8"``,
            each seed has one that is spread evenly over the range.

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
        self._parts = [_Part.of(entry) for entry in entries]
        self.sizes = tuple(len(part) for part in self._parts)
        self._starts = (0, *accumulate(self.sizes))
        self._kept: OrderedDict[int, World] = OrderedDict()

    @classmethod
    def of(cls, worlds: WorldSource) -> WorldPool:
        """Returns the pool of one world or range, or of a list of them. Returns a pool unchanged."""
        if isinstance(worlds, WorldPool):
            return worlds
        return cls(worlds) if isinstance(worlds, (str, World)) else cls(*worlds)

    @property
    def has_ranges(self) -> bool:
        """Whether an entry is a range of seeds."""
        return any(part.generator for part in self._parts)

    def __len__(self) -> int:
        """Number of worlds."""
        return self._starts[-1]

    def name(self, index: int) -> str:
        """Returns the name of world ``index``, for :func:`~rover_rl.sims.worlds.get_world`."""
        part, number = self._locate(index)
        return self._parts[part].name(number)

    def __getitem__(self, index: int) -> World:
        """Returns world ``index``.

        Raises:
            IndexError: if there is no such world.
        """
        world = self._kept.pop(index, None)
        if world is None:
            part, number = self._locate(index)
            world = self._parts[part].world(number)
        self._kept[index] = world
        if len(self._kept) > KEPT_WORLDS:
            self._kept.popitem(last=False)
        return world

    def __iter__(self) -> Iterator[World]:
        """Iterates over all worlds."""
        return (self[index] for index in range(len(self)))

    def _locate(self, index: int) -> tuple[int, int]:
        if not 0 <= index < len(self):
            raise IndexError(f"the pool has {len(self)} worlds, got index {index}")
        part = bisect_right(self._starts, index) - 1
        return part, index - self._starts[part]


@dataclass(frozen=True)
class _Part:
    """Worlds of one entry: one world, or ``count`` seeds of a generator."""

    entry: str | World
    count: int = 1
    generator: str = ""
    first: int = 0
    difficulty: str = ""

    @classmethod
    def of(cls, entry: str | World) -> _Part:
        match = _RANGE.fullmatch(entry) if isinstance(entry, str) else None
        if match is None:
            return cls(entry)
        first = int(match["first"] or 0)
        last = TRAINING_SEEDS - 1 if match["last"] is None else int(match["last"])
        if last < first:
            raise ValueError(f"the seeds of {entry!r} must be in ascending order, as in '{match['name']}:0-99'")
        return cls(entry, last - first + 1, match["name"], first, match["difficulty"] or "")

    def __len__(self) -> int:
        return self.count

    def name(self, number: int) -> str:
        if isinstance(self.entry, World):
            return self.entry.name
        return f"{self.generator}:{self.first + number}{self._difficulty(number)}" if self.generator else self.entry

    def world(self, number: int) -> World:
        return self.entry if isinstance(self.entry, World) else get_world(self.name(number))

    def _difficulty(self, number: int) -> str:
        match = _DIFFICULTIES.fullmatch(self.difficulty)
        if match is None:
            return self.difficulty
        # Multiples of the golden ratio, modulo 1, are spread evenly for any number of consecutive seeds.
        share = (self.first + number) * _GOLDEN_RATIO % 1
        low, high = float(match["low"]), float(match["high"])
        return f"@{low + share * (high - low):.3f}"
