"""Worlds that fit robots: the scale of passages that they need, and the names of worlds with it.

Generated worlds have passages for Rover Zero. A larger robot needs the same layout, wider, and so does a car.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeVar
from weakref import WeakKeyDictionary

from rover_rl.names import SCALES, Name
from rover_rl.robots import Robot, robots_by_entry
from rover_rl.robots.fleet import largest_of
from rover_rl.worlds import World, takes_scale
from rover_rl.worlds.pool import WorldPool, WorldSource

if TYPE_CHECKING:
    from rover_rl.robots import RobotSource

Source = TypeVar("Source")

DISC = 0.35
"""Radius of the disc that generated worlds have room for, m: that of Rover Zero."""
CORRIDOR = 1.0
"""Width of the narrowest corridors of a maze of the default difficulty, m."""
GROUPS = 4
"""Number of groups of robots, which have about the same number of robots."""


def passage_scale(robot: Robot, radius: float | None = None) -> float:
    """Returns the scale of generated worlds that fit a robot with a disc of ``radius``, m: 1 or more, in steps of 0.1.

    The disc of the robot fits as that of Rover Zero does. In a corridor of a maze, a robot that does not turn in place
    has room for its disc on both sides of a turning circle's radius, in which it can turn around in three parts. One
    whose lidar does not see behind has room for its whole turning circle, and need not drive backward.

    Raises:
        ValueError: if it would be more than 10.
    """
    radius = robot.radius if radius is None else radius
    circle = robot.drive.min_radius(robot.wheels) * (1 if robot.sees_behind else 2)
    turning = circle + 2 * radius
    needed = max(radius / DISC, 0.0 if robot.drive.turns_in_place else turning / CORRIDOR)
    scale = max(1.0, math.ceil(10 * needed - 1e-6) / 10)
    if scale > SCALES[1]:
        raise ValueError(
            f"robot {robot.name!r} with a radius of {radius:g} m is too large for generated worlds, "
            f"which would be {scale:g} times as large as for Rover Zero; {SCALES[1]} times is the most"
        )
    return scale


def fitting_worlds(worlds: Source, *robots: Robot) -> Source:
    """Returns worlds with passages wide enough for a robot, or for all of several, where that is left open.

    Names of generated worlds without a scale get that of the robot: ``"maze:5"`` becomes ``"maze:5*1.8"``. Worlds that
    have no scale, such as those of files, and names that state one, as in ``"maze:5*1"``, stay as they are.

    ``worlds`` is a world, a name, a list of both, or a pool.

    Raises:
        ValueError: if a world is unknown, or a robot is too large for any scale.
    """
    return _fitted(worlds, max(map(passage_scale, robots)))


def _fitted(worlds: Any, scale: float) -> Any:
    if isinstance(worlds, World):
        return worlds
    if not isinstance(worlds, str):
        entries = worlds.entries if isinstance(worlds, WorldPool) else worlds
        fitted = [_fitted(entry, scale) for entry in entries]
        if all(a is b for a, b in zip(fitted, entries, strict=True)):
            return worlds
        return WorldPool(*fitted) if isinstance(worlds, WorldPool) else type(worlds)(fitted)
    if scale == 1 or not takes_scale(worlds):
        return worlds
    return str(Name.parse(worlds).replace(scale=scale))


class RobotGroups:
    """Robots of one batch, in groups by the scale of generated worlds that they need.

    Small robots drive in narrow passages, and large ones in wide ones: the worlds of a group fit the one of its robots
    that needs the widest passages. Each episode draws one of the lots. All entries of a list have the same number of
    lots, and the robots of a range share those of their entry.

    Args:
        source: robots, as :func:`~rover_rl.robots.get_robots` takes them.

    Attributes:
        robots: the robots, in the order of their needs.
        lots: index of the robot of each lot, in the same order.
    """

    def __init__(self, source: RobotSource) -> None:
        entries = robots_by_entry(source)
        most = max(map(len, entries))
        drawn = [entry[lot * len(entry) // most] for entry in entries for lot in range(most)]
        robots = dict.fromkeys(drawn)
        # A robot that is alone drives in all worlds. It may be too large for any scale.
        needs = {robot: passage_scale(robot) if len(robots) > 1 else 1.0 for robot in robots}
        drawn.sort(key=needs.__getitem__)
        self.robots, self._needs = tuple(dict.fromkeys(drawn)), [needs[robot] for robot in drawn]
        index = {robot: number for number, robot in enumerate(self.robots)}
        self.lots = tuple(index[robot] for robot in drawn)
        ends = [math.ceil(len(drawn) * group / GROUPS) for group in range(1, GROUPS + 1)]
        # Largest robot of each group.
        self._widest = {self._needs[end - 1]: drawn[end - 1] for end in ends}
        self._worlds: WeakKeyDictionary[World, Robot] = WeakKeyDictionary()

    def spread(self, worlds: WorldSource) -> tuple[WorldSource, list[tuple[int, int]]]:
        """Returns worlds for all groups, and for each entry its first lot and number of lots; none for one robot.

        Where the name of a generated world leaves the scale open, there is an entry for each group. Where it states
        one, the robots that fit drive there. All robots drive in other worlds, and where none fits.
        """
        if len(self.robots) == 1:
            return worlds, []
        entries: list[str | World] = []
        groups: list[tuple[int, int]] = []
        shares: list[float] = []
        for entry in WorldPool.of(worlds).entries:
            if isinstance(entry, str) and takes_scale(entry):
                entries += [fitting_worlds(entry, robot) for robot in self._widest.values()]
                ends = [bisect_right(self._needs, scale) for scale in self._widest]
                groups += [(first, end - first) for first, end in pairwise([0, *ends])]
                shares += [(end - first) / len(self.lots) for first, end in pairwise([0, *ends])]
            else:
                entries.append(entry)
                scale = Name.parse(entry).settings.get("scale") if isinstance(entry, str) else None
                groups.append((0, (scale and bisect_right(self._needs, scale)) or len(self.lots)))
                shares.append(1.0)
        drivers = ({*self.lots[first : first + count]} for first, count in groups)
        largest = [largest_of(self.robots[number] for number in sorted(numbers)) for numbers in drivers]
        return _Pool(entries, shares, largest, self._worlds), groups

    def largest_in(self, world: World) -> Robot:
        """Returns the robot that needs the most space of those that drive in a world of the last :meth:`spread`."""
        return self._worlds.get(world) or largest_of(self.robots)


class _Pool(WorldPool):
    """Pool that notes the largest robot of each world that it makes, with the ``shares`` of its entries."""

    def __init__(
        self,
        entries: Sequence[str | World],
        shares: Sequence[float],
        largest: Sequence[Robot],
        worlds: WeakKeyDictionary[World, Robot],
    ) -> None:
        super().__init__(*entries)
        self.shares = tuple(share / sum(shares) for share in shares)
        self._largest, self._noted = largest, worlds

    def __getitem__(self, index: int) -> World:
        world = super().__getitem__(index)
        self._noted[world] = self._largest[bisect_right(self._starts, index) - 1]
        return world

    def __reduce__(self) -> tuple[Any, ...]:
        return WorldPool, self.entries
