"""Rooms: a building of one floor with rooms along a corridor, doors and furniture.

Lengths are in decimeters unless they name another unit, as whole numbers, so that walls and doors lie on the lines of a
grid of 0.1 m.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import label

from rover_rl.worlds.generators.layouts import DEFAULT, WALL_HEIGHT, enclosing_walls, scaled, square
from rover_rl.worlds.solids import Solids, boxes
from rover_rl.worlds.terrain import Terrain
from rover_rl.worlds.world import World

SIDE = 140
"""Side length of the building."""
WALL, DOOR_MARGIN = 1, 3
"""Thickness of the walls, and minimum distance between a door and the corner of a room."""
CORRIDOR, SMALLEST, DOOR = (20, 16, 12), (42, 33, 26), (14, 11, 9)
"""Width of the corridor, least width and depth of a room, and width of the doors, at difficulty 0, 0.5 and 1."""
EXTRA_DOORS = (0.8, 0.3, 0.0)
"""Fraction of adjacent rooms with a door that is no part of the only way between them."""
FURNITURE = (0.06, 0.13, 0.22)
"""Number of pieces of furniture for each square meter of a room."""
GAP = (14, 11, 9)
"""Minimum gap between two pieces of furniture, and between a piece and a wall that it does not stand at."""
ATTEMPTS = 4
DOORWAY = 10
"""Depth of the free space on both sides of a door."""
REACH = 4.2
"""Distance of the rover's center from the solids for which the ways are checked. The turning circle has 3.5."""
KINDS = (
    # at a wall, range of the length along the wall, range of the depth, height (m)
    (True, (8, 20), (3, 5), 1.8),  # shelf
    (True, (14, 22), (7, 9), 0.5),  # sofa
    (True, (5, 9), (5, 6), 1.0),  # cabinet
    (False, (12, 20), (8, 11), 0.0),  # table, which stands on four legs
    (False, (5, 9), (5, 9), 0.6),  # crate
)
"""Kinds of furniture. All are visible to the lidar, at 0.32 m."""
LEG, TABLE_TOP = 1, (0.70, 0.75)
"""Side length of the legs of a table, and lowest and highest point of its top (m). The rover, 0.35 m, fits below."""


def rooms(seed: int = 0, difficulty: float = DEFAULT) -> World:
    """Creates a building of 14 x 14 m: a corridor, rooms with doors, and furniture. All rooms are reachable.

    With the difficulty, rooms get smaller and more, doors narrow from 1.4 m over 1.1 m (at 0.5) to 0.9 m and the
    corridor from 2 m to 1.2 m, furniture gets denser, and there are fewer ways around: at 1, rooms have a single way to
    each other.
    """
    rng = np.random.default_rng(seed)
    corridor, smallest, door, gap = (round(scaled(difficulty, *lengths)) for lengths in (CORRIDOR, SMALLEST, DOOR, GAP))
    plan = floor_plan(rng, SIDE, corridor, smallest, door, scaled(difficulty, *EXTRA_DOORS))
    furniture = _furniture(rng, plan, scaled(difficulty, *FURNITURE), gap)
    # Furniture that blocks a way is removed. Without any, all rooms are reachable.
    while not _reachable(plan, furniture):
        furniture.pop()
    obstacles, half = (enclosing_walls(SIDE / 10), _solids(plan, furniture)), SIDE / 20
    return World("rooms", Terrain.flat((2 * half, 2 * half)), obstacles, square(half), bounds=square(half + 1))


class Rect(NamedTuple):
    """Rectangle between two corners."""

    left: int
    bottom: int
    right: int
    top: int

    @property
    def size(self) -> tuple[int, int]:
        return self.right - self.left, self.top - self.bottom

    def overlaps(self, other: Rect, gap: int = 0) -> bool:
        """Whether the rectangles overlap, or are closer than ``gap`` along both axes."""
        x = self.left < other.right + gap and other.left < self.right + gap
        return x and self.bottom < other.top + gap and other.bottom < self.top + gap

    def transposed(self) -> Rect:
        return Rect(self.bottom, self.left, self.top, self.right)


class FloorPlan(NamedTuple):
    """Rooms (without their walls, the corridor first), doors (as thick as walls) and parts of the inner walls."""

    rooms: tuple[Rect, ...]
    doors: tuple[Rect, ...]
    walls: tuple[Rect, ...]

    def transposed(self) -> FloorPlan:
        return FloorPlan(*(tuple(map(Rect.transposed, part)) for part in self))


def floor_plan(
    rng: np.random.Generator, side: int, corridor: int, smallest: int, door: int, extra_doors: float
) -> FloorPlan:
    """Samples a floor plan of a square building around the origin.

    Rooms are split until they are too small for another wall. A random spanning tree of adjacent rooms has doors,
    preferably to the corridor, so that every room is reachable, and a fraction ``extra_doors`` of the others.
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
        rooms = [*map(Rect.transposed, _split(rng, part.transposed(), smallest, turned))]
        walls += map(Rect.transposed, turned)
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
        return [*map(Rect.transposed, _without_doors(wall.transposed(), [*map(Rect.transposed, doors)]))]
    in_wall = sorted(door for door in doors if door.overlaps(wall) and door[1::2] == wall[1::2])
    ends = [wall.left, *(end for door in in_wall for end in (door.left, door.right)), wall.right]
    return [wall._replace(left=left, right=right) for left, right in zip(ends[::2], ends[1::2], strict=True)]


def _furniture(rng: np.random.Generator, plan: FloorPlan, density: float, gap: int) -> list[tuple[Rect, float]]:
    """Samples the outlines and heights (m; 0: a table) of the furniture of all rooms but the corridor."""
    furniture: list[tuple[Rect, float]] = []
    for room in plan.rooms[1:]:
        width, depth = room.size
        doorways = [doorway for doorway in map(_doorway, plan.doors) if doorway.overlaps(room)]
        placed: list[Rect] = []
        for _ in range(round(density * width * depth / 100)):
            kind = KINDS[int(rng.integers(len(KINDS)))]
            places = (_place(rng, room, kind, gap) for _ in range(ATTEMPTS))
            for piece in filter(None, places):
                if not any(map(piece.overlaps, doorways)) and not any(piece.overlaps(other, gap) for other in placed):
                    placed.append(piece)
                    furniture.append((piece, kind[3]))
                    break
    return furniture


def _doorway(door: Rect) -> Rect:
    x, y = (DOORWAY if thickness == WALL else 0 for thickness in door.size)
    return Rect(door.left - x, door.bottom - y, door.right + x, door.top + y)


def _place(rng: np.random.Generator, room: Rect, kind: tuple, gap: int) -> Rect | None:
    """Samples a position of a piece of furniture in a room. Returns ``None`` if it does not fit."""
    at_wall, lengths, depths, _ = kind
    length, depth = int(rng.integers(lengths[0], lengths[1] + 1)), int(rng.integers(depths[0], depths[1] + 1))
    turned = rng.random() < 0.5
    room = room.transposed() if turned else room
    low, high = room.left + gap, room.right - gap - length
    bottom, top = room.bottom + gap, room.top - gap - depth
    if high < low or (top < bottom and not at_wall) or room.size[1] < depth + gap:
        return None
    left = int(rng.integers(low, high + 1))
    if at_wall:
        bottom = room.bottom if rng.random() < 0.5 else room.top - depth
    else:
        bottom = int(rng.integers(bottom, top + 1))
    piece = Rect(left, bottom, left + length, bottom + depth)
    return piece.transposed() if turned else piece


def _legs(table: Rect) -> list[Rect]:
    corners = [(x, y) for x in (table.left, table.right - LEG) for y in (table.bottom, table.top - LEG)]
    return [Rect(x, y, x + LEG, y + LEG) for x, y in corners]


def _reachable(plan: FloorPlan, furniture: list[tuple[Rect, float]]) -> bool:
    free = np.zeros((SIDE, SIDE), dtype=bool)
    border = int(np.ceil(REACH))
    free[border:-border, border:-border] = True
    outlines = [part for piece, height in furniture for part in (_legs(piece) if height == 0 else [piece])]
    # A cell is blocked if its center, half a decimeter from its corner, lies in the extended rectangle.
    extended = np.array((*plan.walls, *outlines)) + SIDE / 2 + np.array((-REACH, -REACH, REACH, REACH)) - 0.5
    for left, bottom, right, top in np.ceil(extended).astype(int).clip(0).tolist():
        free[bottom:top, left:right] = False
    parts, _ = label(free)
    middles = [((bottom + top + SIDE) // 2, (left + right + SIDE) // 2) for left, bottom, right, top in plan.doors]
    reached = {int(parts[middle]) for middle in middles}
    return len(reached) == 1 and 0 not in reached


def _solids(plan: FloorPlan, furniture: list[tuple[Rect, float]]) -> Solids:
    parts = [(*wall, 0.0, WALL_HEIGHT) for wall in plan.walls]
    for piece, height in furniture:
        parts += [] if height else [(*leg, 0.0, TABLE_TOP[0]) for leg in _legs(piece)]
        parts.append((*piece, 0.0, height) if height else (*piece, *TABLE_TOP))
    ends = np.array(parts)
    low, high = ends[:, [0, 1, 4]] / (10, 10, 1), ends[:, [2, 3, 5]] / (10, 10, 1)
    return boxes((low + high) / 2, high - low)
