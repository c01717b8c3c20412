"""Rooms: a building of one floor with rooms along a corridor, doors and furniture."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import label

from rover_rl.worlds.generators.floor_plan import WALL, FloorPlan, Rect, floor_plan
from rover_rl.worlds.generators.layouts import DEFAULT, WALL_HEIGHT, enclosing_walls, scaled
from rover_rl.worlds.solids import Solids, boxes
from rover_rl.worlds.terrain import Terrain
from rover_rl.worlds.world import World

SIDE = 140
"""Side length of the building, dm. All lengths in this module are in decimeters unless they name another unit."""
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
    half = SIDE / 20
    area = ((-half, half), (-half, half))
    return World(
        name="rooms",
        terrain=Terrain.flat((SIDE / 10, SIDE / 10)),
        obstacles=(enclosing_walls(SIDE / 10), _solids(plan, furniture)),
        spawn_range=area,
        bounds=((-half - 1, half + 1), (-half - 1, half + 1)),
    )


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
        if height > 0:
            parts.append((*piece, 0.0, height))
        else:
            parts += [(*leg, 0.0, TABLE_TOP[0]) for leg in _legs(piece)]
            parts.append((*piece, *TABLE_TOP))
    left, bottom, right, top, low, high = np.array(parts).T
    x, y = np.stack((left, right)) / 10, np.stack((bottom, top)) / 10
    z = np.stack((low, high))
    return boxes(np.stack((x.mean(0), y.mean(0), z.mean(0)), -1), np.stack((x[1] - x[0], y[1] - y[0], z[1] - z[0]), -1))
