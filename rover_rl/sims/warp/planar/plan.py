"""The plan of a level world: the edges of its obstacles, and lists of those that are near or in view."""

from __future__ import annotations

import numpy as np

from rover_rl.native.warp import wp
from rover_rl.sims.scenes.table import Contents
from rover_rl.sims.warp.planar.view import Sight
from rover_rl.worlds import World
from rover_rl.worlds.solids import Solids

LEVEL = 1e-3
"""Largest difference of heights of level ground, m."""
UPRIGHT = 1e-6
"""Largest sine of the angle between a face of a prism and the vertical or the horizontal."""
NEAR_CELL, VIEW_CELL = 1.0, 2.0
"""Side of the cells that list the edges which a rover may touch, and of those that list what a lidar may see, m."""
MAX_MARGIN = 0.4
"""Largest distance at which contacts are looked for, m: what a rover and an obstacle approach in a substep."""
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
    # Edges that a rover in a cell may touch; outside of the grid, there are none.
    near: Cells
    near_starts: wp.array[int]
    near_edges: wp.array[int]
    # Edges that a lidar in a cell may see; outside of the grid, it may see all.
    view: Cells
    view_starts: wp.array[int]
    view_edges: wp.array[int]


@wp.func
def cell_at(cells: Cells, x: float, y: float) -> int:
    """Number of the cell at a point; -1 outside of the grid."""
    column = int(wp.floor((x - cells.origin[0]) / cells.side))
    row = int(wp.floor((y - cells.origin[1]) / cells.side))
    if column < 0 or row < 0 or column >= cells.columns or row >= cells.rows:
        return -1
    return row * cells.columns + column


def plan_contents(world: World, reach: float, farthest: float, lidars: np.ndarray) -> Contents:
    """Returns the contents of a :class:`Plan`, for rovers within a ``reach`` and lidars that see ``farthest`` (m) far.

    Both are distances from the origin of the rover; ``lidars [K]`` are the heights of lidars, m.
    """
    ground = float(world.terrain.heights.mean())
    solids = Solids.of(world.obstacles)
    spans = np.stack([corner[:, 2] - ground for corner in solids.bounding_boxes], 1)
    sight = Sight(solids.outlines, spans)
    edges, owners = sight.free_edges()
    ends, reach, heights = edges.reshape(-1, 2), reach + MAX_MARGIN, (float(lidars.min()), float(lidars.max()))
    around = np.concatenate((ends - reach, ends + reach))
    near, near_starts, near_edges = _listed(sight, edges, around, NEAR_CELL, reach, (1.0, 0.0))
    driven = np.concatenate((ends, np.transpose(world.spawn_range), np.transpose(world.goal_range)))
    view, view_starts, view_edges = _listed(sight, edges, driven, VIEW_CELL, farthest, heights)
    lists = {"near_starts": near_starts, "near_edges": near_edges, "view_starts": view_starts, "view_edges": view_edges}
    arrays = {"edges": edges.astype(np.float32), "spans": spans[owners].astype(np.float32)}
    return {"ground": ground, "near": near, "view": view}, arrays | lists


def plan_problem(world: World, climb: float, tops: np.ndarray, lidars: np.ndarray) -> str | None:
    """Tells why a world has no plan for robots, as the rest of a sentence; ``None`` if it has.

    A rover may climb what is lower than the highest axle, ``climb``; robots have bodies as high as ``tops [K]``, and
    ``lidars [K]``, m.
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


def _listed(
    sight: Sight, edges: np.ndarray, points: np.ndarray, side: float, reach: float, heights: tuple[float, float]
) -> tuple[Cells, np.ndarray, np.ndarray]:
    """Grid of cells around ``points``, where the list of each cell starts, and the lists of :meth:`Sight.edges_of`."""
    cells = Cells()
    cells.side = side
    starts, found = [np.zeros(1, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    if len(edges):
        corner = points.min(0)
        columns, rows = (np.ceil((points.max(0) - corner) / side).astype(int) + 1).tolist()
        cells.origin, cells.columns, cells.rows = wp.vec2(*corner.tolist()), columns, rows
        y, x = np.divmod(np.arange(rows * columns), columns)
        middles = corner + side * (np.stack((x, y), 1) + 0.5)
        for some in np.array_split(middles, 1 + len(middles) * len(edges) // MAX_PAIRS):
            seen = sight.edges_of(some, side, edges, reach, heights)
            found.append(np.nonzero(seen)[1])
            starts.append(seen.sum(1))
    return cells, np.concatenate(starts).cumsum().astype(np.int32), np.concatenate(found).astype(np.int32)
