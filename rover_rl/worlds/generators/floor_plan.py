"""Floor plans: rooms along a corridor, and doors between them.

All lengths are in decimeters, as whole numbers, so that walls and doors lie on the lines of a grid of 0.1 m.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

WALL = 1
DOOR_MARGIN = 3
"""Minimum distance between a door and the corner of a room."""


class Rect(NamedTuple):
    """Rectangle between two corners."""

    left: int
    bottom: int
    right: int
    top: int

    @property
    def size(self) -> tuple[int, int]:
        """Width and depth."""
        return self.right - self.left, self.top - self.bottom

    def overlaps(self, other: Rect, gap: int = 0) -> bool:
        """Returns whether the rectangles overlap or are closer than ``gap`` along both axes."""
        return (
            self.left < other.right + gap
            and other.left < self.right + gap
            and self.bottom < other.top + gap
            and other.bottom < self.top + gap
        )

    def transposed(self) -> Rect:
        """Returns the rectangle with x and y exchanged."""
        return Rect(self.bottom, self.left, self.top, self.right)


@dataclass(frozen=True)
class FloorPlan:
    """Rooms (without their walls, the corridor first), doors (as thick as walls) and parts of the inner walls."""

    rooms: tuple[Rect, ...]
    doors: tuple[Rect, ...]
    walls: tuple[Rect, ...]

    def transposed(self) -> FloorPlan:
        """Returns the plan with x and y exchanged."""
        parts = (tuple(rect.transposed() for rect in part) for part in (self.rooms, self.doors, self.walls))
        return FloorPlan(*parts)


def floor_plan(
    rng: np.random.Generator, side: int, corridor: int, smallest: int, door: int, extra_doors: float
) -> FloorPlan:
    """Samples a floor plan of a square building around the origin.

    Rooms are split until they are too small for another wall. A random spanning tree of adjacent rooms has doors,
    preferably to the corridor, so that every room is reachable, and a fraction of the others.

    Args:
        rng: random number generator.
        side: side length of the building.
        corridor: width of the corridor.
        smallest: minimum width and depth of a room.
        door: width of the doors.
        extra_doors: fraction of the other pairs of rooms that have a door, too.
    """
    half = side // 2
    walls: list[Rect] = []
    bottom = int(rng.integers(-half + smallest + WALL, half - smallest - WALL - corridor + 1))
    top = bottom + corridor
    walls += [Rect(-half, bottom - WALL, half, bottom), Rect(-half, top, half, top + WALL)]
    rooms = [Rect(-half, bottom, half, top)]
    for part in (Rect(-half, -half, half, bottom - WALL), Rect(-half, top + WALL, half, half)):
        rooms += _split(rng, part, smallest, walls)
    doors = _doors(rng, rooms, door, extra_doors)
    pieces = tuple(piece for wall in walls for piece in _without_doors(wall, doors))
    plan = FloorPlan(tuple(rooms), tuple(doors), pieces)
    return plan.transposed() if rng.random() < 0.5 else plan


def _split(rng: np.random.Generator, part: Rect, smallest: int, walls: list[Rect]) -> list[Rect]:
    width, depth = part.size
    if max(width, depth) < 2 * smallest + WALL:
        return [part]
    if width < depth:
        turned: list[Rect] = []
        rooms = [room.transposed() for room in _split(rng, part.transposed(), smallest, turned)]
        walls += [wall.transposed() for wall in turned]
        return rooms
    at = int(rng.integers(part.left + smallest, part.right - smallest - WALL + 1))
    walls.append(Rect(at, part.bottom, at + WALL, part.top))
    left, right = part._replace(right=at), part._replace(left=at + WALL)
    return _split(rng, left, smallest, walls) + _split(rng, right, smallest, walls)


def _doors(rng: np.random.Generator, rooms: list[Rect], door: int, extra_doors: float) -> list[Rect]:
    pairs = [(i, j, _shared_wall(a, b)) for i, a in enumerate(rooms) for j, b in enumerate(rooms)]
    wide = [(i, j, wall) for i, j, wall in pairs if max(wall.size) >= door + 2 * DOOR_MARGIN and min(wall.size) > 0]
    shuffled = [wide[k] for k in rng.permutation(len(wide))]
    # The doors of the corridor come first, so that few rooms are reached only through others.
    shuffled.sort(key=lambda pair: 0 not in pair[:2])
    group = list(range(len(rooms)))
    doors = []
    for i, j, wall in shuffled:
        if group[i] == group[j] and rng.random() >= extra_doors:
            continue
        group = [group[i] if other == group[j] else other for other in group]
        doors.append(_door(rng, wall, door))
    return doors


def _shared_wall(a: Rect, b: Rect) -> Rect:
    if b.left == a.right + WALL:
        return Rect(a.right, max(a.bottom, b.bottom), b.left, min(a.top, b.top))
    if b.bottom == a.top + WALL:
        return Rect(max(a.left, b.left), a.top, min(a.right, b.right), b.bottom)
    return Rect(0, 0, 0, 0)


def _door(rng: np.random.Generator, wall: Rect, door: int) -> Rect:
    width, depth = wall.size
    if width < depth:
        return _door(rng, wall.transposed(), door).transposed()
    at = int(rng.integers(wall.left + DOOR_MARGIN, wall.right - DOOR_MARGIN - door + 1))
    return wall._replace(left=at, right=at + door)


def _without_doors(wall: Rect, doors: list[Rect]) -> list[Rect]:
    width, depth = wall.size
    if width < depth:
        turned = [door.transposed() for door in doors]
        return [part.transposed() for part in _without_doors(wall.transposed(), turned)]
    on_wall = sorted(
        door for door in doors if door.overlaps(wall) and (door.bottom, door.top) == (wall.bottom, wall.top)
    )
    ends = [wall.left, *(end for door in on_wall for end in (door.left, door.right)), wall.right]
    return [wall._replace(left=left, right=right) for left, right in zip(ends[::2], ends[1::2], strict=True)]
