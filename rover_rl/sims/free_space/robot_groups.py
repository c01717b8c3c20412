"""``RobotGroups``: which of the robots of a batch drive in which worlds."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise
from typing import Any
from weakref import WeakKeyDictionary

from rover_rl.robots import Robot
from rover_rl.robots.fleet import largest_of
from rover_rl.sims.free_space.fitting import fitting_worlds, passage_scale
from rover_rl.worlds import World, WorldName, takes_scale
from rover_rl.worlds.names import WorldRange, is_world_file
from rover_rl.worlds.pool import WorldPool, WorldSource

GROUPS = 4
"""Number of groups, which have about the same number of robots."""


class RobotGroups:
    """Robots of one batch, in groups by the scale of generated worlds that they need.

    Small robots drive in narrow passages, and large ones in wide ones: the worlds of a group fit the one of its robots
    that needs the widest passages.

    Args:
        robots: the robots.

    Attributes:
        robots: the robots, in the order of their needs.
    """

    def __init__(self, robots: Sequence[Robot]) -> None:
        # A robot that is alone drives in all worlds. It may be too large for any scale.
        needs = [passage_scale(robot) if len(robots) > 1 else 1.0 for robot in robots]
        order = sorted(range(len(robots)), key=needs.__getitem__)
        self.robots, self._needs = tuple(robots[number] for number in order), sorted(needs)
        ends = [math.ceil(len(robots) * group / GROUPS) for group in range(1, GROUPS + 1)]
        # Largest robot of each group.
        self._widest = {self._needs[end - 1]: self.robots[end - 1] for end in ends}
        self._worlds: WeakKeyDictionary[World, Robot] = WeakKeyDictionary()

    def spread(self, worlds: WorldSource) -> tuple[WorldSource, list[tuple[int, int]]]:
        """Returns worlds for all groups, and for each entry its first robot and number of robots; none for one robot.

        Where the name of a generated world leaves the scale open, there is an entry for each group. Where it states
        one, the robots that fit drive there. All robots drive in other worlds, and where none fits.

        Args:
            worlds: world, name, list of both, or pool.
        """
        if len(self.robots) == 1:
            return worlds, []
        entries: list[str | World] = []
        groups = []
        for entry in WorldPool.of(worlds).entries:
            if isinstance(entry, str) and takes_scale(entry):
                entries += [fitting_worlds(entry, robot) for robot in self._widest.values()]
                ends = [bisect_right(self._needs, scale) for scale in self._widest]
                groups += [(first, end - first) for first, end in pairwise([0, *ends])]
            else:
                entries.append(entry)
                scale = _scale_of(entry) if isinstance(entry, str) else None
                groups.append((0, (scale and bisect_right(self._needs, scale)) or len(self.robots)))
        largest = [largest_of(self.robots[first : first + count]) for first, count in groups]
        return _Pool(entries, largest, self._worlds), groups

    def largest_in(self, world: World) -> Robot:
        """Returns the robot that needs the most space of those that drive in a world of the last :meth:`spread`."""
        return self._worlds.get(world) or largest_of(self.robots)


class _Pool(WorldPool):
    """Pool that notes the largest robot of each world that it makes."""

    def __init__(
        self, entries: Sequence[str | World], largest: Sequence[Robot], worlds: WeakKeyDictionary[World, Robot]
    ) -> None:
        super().__init__(*entries)
        self._largest, self._noted = largest, worlds

    def __getitem__(self, index: int) -> World:
        world = super().__getitem__(index)
        self._noted[world] = self._largest[bisect_right(self._starts, index) - 1]
        return world

    def __reduce__(self) -> tuple[Any, ...]:
        return WorldPool, self.entries


def _scale_of(name: str) -> float | None:
    """Returns the scale that the name of a world or a range states."""
    return None if is_world_file(name) else (WorldRange.parse(name) or WorldName.parse(name)).scale
