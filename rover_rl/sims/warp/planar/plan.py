"""The plan of a level world: the edges of its obstacles, and lists of those that are near or in view."""

from __future__ import annotations

import numpy as np

from rover_rl.native.warp import wp
from rover_rl.sims.scenes.table import Contents
from rover_rl.sims.warp.planar.view import visible_distances
from rover_rl.worlds import World
from rover_rl.worlds.solids import Solids

LEVEL = 1e-3
"""Largest difference of heights of level ground, m."""
UPRIGHT = 1e-6
"""Largest sine of the angle between a face of a prism and the vertical or the horizontal."""
NEAR_CELL, VIEW_CELL = 0.5, 1.0
"""Side of the cells that list the edges which a rover may touch, and of those that list what a lidar may see, m."""
MAX_MARGIN = 0.4
"""Largest distance at which contacts are looked for, m: what a rover and an obstacle approach in a substep."""
INSIDE = 1e-3
"""Depth behind the face of another obstacle from which on an edge is hidden, m."""
MAX_PAIRS = 1 << 21
"""Maximum number of pairs of a cell and an edge that are in memory at a time."""


@wp.struct
class Cells:
    """Grid of square cells, each with a list of edges: cell ``k`` has entries ``starts[k]`` to ``starts[k + 1]``."""

    origin: wp.vec2
    side: float
    columns: int
    rows: int


@wp.struct
class Plan:
    """A level world. Outlines of obstacles are convex and counter-clockwise: free space is to the right of an edge."""

    # Height of the ground in the world frame, m.
    ground: float
    # Ends (ax, ay, bx, by) of each edge, and lowest and highest point of its face above the ground, m.
    edges: wp.array[wp.vec4]
    spans: wp.array[wp.vec2]
    # Edges that a rover in a cell may touch.
    near: Cells
    near_starts: wp.array[int]
    near_edges: wp.array[int]
    # Edges that a lidar in a cell may see, from near to far, and lower bounds of their distances, m.
    view: Cells
    view_starts: wp.array[int]
    view_edges: wp.array[int]
    view_distances: wp.array[float]


@wp.func
def cell_at(cells: Cells, x: float, y: float) -> int:
    """Number of the cell at a point; -1 outside of the grid, where there are no edges."""
    column = int(wp.floor((x - cells.origin[0]) / cells.side))
    row = int(wp.floor((y - cells.origin[1]) / cells.side))
    if column < 0 or row < 0 or column >= cells.columns or row >= cells.rows:
        return -1
    return row * cells.columns + column


def plan_contents(world: World, reach: float, sight: float, lidars: np.ndarray) -> Contents:
    """Returns the contents of a :class:`Plan`, for rovers within a ``reach`` and lidars that see ``sight`` (m) far.

    Both are distances from the origin of the rover; ``lidars [K]`` are the heights of lidars, m.
    """
    ground = float(world.terrain.heights.mean())
    outlines, spans = _outlines(world, ground)
    edges, owners = _free_edges(outlines, spans)
    near, near_lists = _listed(edges, NEAR_CELL, reach + MAX_MARGIN, [])
    # An obstacle hides others from lidars in whose plane it is.
    tall = [one for one, span in zip(outlines, spans, strict=True) if span[0] < lidars.min() and span[1] > lidars.max()]
    view, view_lists = _listed(edges, VIEW_CELL, sight, tall)
    numbers = {"ground": ground, "near": near, "view": view}
    arrays = {"edges": edges.astype(np.float32), "spans": spans[owners].astype(np.float32)}
    near_arrays = {"near_starts": near_lists[0], "near_edges": near_lists[1]}
    views = dict(zip(("view_starts", "view_edges", "view_distances"), view_lists, strict=True))
    return numbers, arrays | near_arrays | views


def plan_problem(world: World, climb: float, tops: np.ndarray, lidars: np.ndarray) -> str | None:
    """Tells why a world has no plan for robots, as the rest of a sentence; ``None`` if it has.

    Args:
        world: world.
        climb: height of the highest axle, m. A rover may climb what is lower.
        tops, lidars: heights of each robot's body and lidar, ``[K]``, m.
    """
    heights = world.terrain.heights.numpy()
    if heights.max() - heights.min() > LEVEL:
        return "has ground that is not level"
    solids = Solids.of(world.obstacles)
    if not solids:
        return None
    upward = np.abs(solids.planes[:, 2].numpy())
    low, high = (corner[:, 2] - float(heights.mean()) for corner in solids.bounding_boxes)
    met = (high > LEVEL) & (low < max(tops.max(), lidars.max()))
    slanted = np.repeat(met, np.diff(solids.plane_starts)) & (upward > UPRIGHT) & (upward < 1 - UPRIGHT)
    if slanted.any():
        return "has obstacles with slanted faces"
    if (met & (high < climb)).any():
        return f"has obstacles lower than {climb:.2f} m, which wheels could climb"
    above = met & (low > tops[:, None] - LEVEL)
    if (above & (low < lidars[:, None]) & (lidars[:, None] < high)).any():
        return "has obstacles that a lidar could enter above the body of the robot"
    return None


def _outlines(world: World, ground: float) -> tuple[list[np.ndarray], np.ndarray]:
    """Edges of the outline of each obstacle, ``[K, 4]``, and their lowest and highest points ``[N, 2]``, m."""
    solids = Solids.of(world.obstacles)
    low, high = (corner[:, 2] - ground for corner in solids.bounding_boxes)
    return [np.concatenate((one, np.roll(one, -1, 0)), 1) for one in solids.outlines], np.stack((low, high), 1)


def _free_edges(outlines: list[np.ndarray], spans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges that do not lie within another obstacle, ``[E, 4]``, and the obstacles that they are of, ``[E]``."""
    edges = np.concatenate([np.empty((0, 4)), *outlines])
    owners = np.repeat(np.arange(len(outlines)), [len(outline) for outline in outlines])
    along = edges[:, 2:] - edges[:, :2]
    length = np.linalg.norm(along, axis=1)
    outward = np.stack((along[:, 1], -along[:, 0]), 1) / np.maximum(length, 1e-9)[:, None]
    hidden = length < 1e-6
    # Both ends, moved a little to the outside.
    ends = np.stack((edges[:, :2], edges[:, 2:]), 1) + INSIDE * outward[:, None]
    offset = (outward * edges[:, :2]).sum(1)
    for number in range(len(outlines)):
        own = owners == number
        depth = (ends @ outward[own].T - offset[own]).max(-1).max(-1)
        covers = (spans[number, 0] <= spans[owners, 0] + 1e-9) & (spans[number, 1] >= spans[owners, 1] - 1e-9)
        hidden |= (depth < -1e-9) & covers & ~own
    return edges[~hidden], owners[~hidden]


def _listed(edges: np.ndarray, side: float, reach: float, tall: list[np.ndarray]) -> tuple[Cells, list[np.ndarray]]:
    """Grid of cells, and what :func:`visible_distances` finds: starts, edges from near to far, and distances (m)."""
    cells = Cells()
    cells.side = side
    starts = np.zeros(1, dtype=np.int32)
    if not len(edges):
        return cells, [starts, starts[:0], np.zeros(0, dtype=np.float32)]
    ends = edges.reshape(-1, 2)
    corner = ends.min(0) - reach
    columns, rows = np.ceil((ends.max(0) + reach - corner) / side).astype(int).tolist()
    cells.origin, cells.columns, cells.rows = wp.vec2(*corner.tolist()), columns, rows
    y, x = np.divmod(np.arange(rows * columns), columns)
    middles = corner + side * (np.stack((x, y), 1) + 0.5)
    counts, found, bounds = [starts], list[np.ndarray](), list[np.ndarray]()
    for some in np.array_split(middles, max(1, len(middles) * len(edges) // MAX_PAIRS)):
        least = visible_distances(edges, some, side, reach, tall)
        order = np.argsort(least, axis=1, kind="stable")
        count = (least < np.inf).sum(1)
        first = np.arange(len(edges)) < count[:, None]
        found.append(order[first])
        bounds.append(np.take_along_axis(least, order, 1)[first])
        counts.append(count)
    arrays = [np.cumsum(np.concatenate(counts)), np.concatenate(found), np.concatenate(bounds)]
    kinds = (np.int32, np.int32, np.float32)
    return cells, [array.astype(kind) for array, kind in zip(arrays, kinds, strict=True)]
