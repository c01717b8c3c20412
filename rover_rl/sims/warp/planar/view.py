"""What a lidar can see from somewhere in a cell: edges that no obstacle hides from all of it."""

from __future__ import annotations

import numpy as np

from rover_rl.native.warp import wp

CLEAR = 2.0e-3
"""Distance in front of an edge up to which obstacles do not hide it, as its own does not, m."""


@wp.func
def crosses(outlines: wp.array[wp.vec4], first: int, end: int, a: wp.vec2, b: wp.vec2) -> bool:
    """Whether a segment meets a convex outline, whose edges are those from ``first`` to ``end``."""
    enters = float(0.0)
    leaves = float(1.0)
    for k in range(first, end):
        edge = outlines[k]
        outward = wp.vec2(edge[3] - edge[1], edge[0] - edge[2])
        corner = wp.vec2(edge[0], edge[1])
        height = wp.dot(outward, a - corner)
        change = wp.dot(outward, b - a)
        if change < 0.0:
            enters = wp.max(enters, -height / change)
        elif height > 0.0:
            return False
        elif change > 0.0:
            leaves = wp.min(leaves, -height / change)
        if enters > leaves:
            return False
    return True


@wp.func
def hides(outlines: wp.array[wp.vec4], first: int, end: int, middle: wp.vec2, half: float, edge: wp.vec4) -> bool:
    """Whether an outline hides an edge from all of a square cell.

    It does if it meets the four segments from corners of the cell to each end of the edge. For if a segment from a
    point of the cell to one of the edge missed the outline, a line would separate the two convex sets; and on its side
    of the line there would be a corner of the cell and an end of the edge, and the segment between them.
    """
    # A loop to a constant is unrolled, which takes long to compile.
    pairs = int(8)
    for k in range(pairs):
        corner = middle + half * wp.vec2(wp.where(k & 1 == 0, -1.0, 1.0), wp.where(k & 2 == 0, -1.0, 1.0))
        target = wp.vec2(edge[0], edge[1])
        if k >= 4:
            target = wp.vec2(edge[2], edge[3])
        if not crosses(outlines, first, end, corner, target):
            return False
    return True


@wp.kernel
def look(
    edges: wp.array[wp.vec4],
    middles: wp.array[wp.vec2],
    half: float,
    reach: float,
    outlines: wp.array[wp.vec4],
    starts: wp.array[int],
    distances: wp.array2d[float],
):
    """Writes a lower bound of the distance of each edge from each square cell; ``inf`` if no lidar there sees it."""
    cell, number = wp.tid()
    edge = edges[number]
    middle = middles[cell]
    start = wp.vec2(edge[0], edge[1])
    along = wp.vec2(edge[2], edge[3]) - start
    offset = middle - start
    outward = wp.normalize(wp.vec2(along[1], -along[0]))
    radius = 1.41421356 * half
    share = wp.clamp(wp.dot(offset, along) / wp.length_sq(along), 0.0, 1.0)
    least = wp.max(wp.length(offset - share * along) - radius, 0.0)
    distances[cell, number] = wp.inf
    # The free side of an edge is in front of it.
    if wp.dot(offset, outward) < -radius or least >= reach:
        return
    moved = edge + CLEAR * wp.vec4(outward[0], outward[1], outward[0], outward[1])
    for k in range(starts.shape[0] - 1):
        if hides(outlines, starts[k], starts[k + 1], middle, half, moved):
            return
    distances[cell, number] = least


def visible_distances(
    edges: np.ndarray, middles: np.ndarray, side: float, reach: float, outlines: list[np.ndarray]
) -> np.ndarray:
    """Lower bounds of the distances (m) of edges ``[E, 4]`` from square cells, ``[C, E]``; ``inf``: not in view.

    Args:
        edges: edges of obstacles, as in :class:`~rover_rl.sims.warp.planar.plan.Plan`.
        middles: middles of the cells, ``[C, 2]``, m.
        side: side of a cell, m.
        reach: largest distance of an edge in view, m.
        outlines: edges of each convex obstacle that may hide others, ``[K, 4]``.
    """
    sizes = np.cumsum([0, *map(len, outlines)]).astype(np.int32)
    joined = np.concatenate([np.empty((0, 4)), *outlines]).astype(np.float32)
    found = wp.empty((len(middles), len(edges)), dtype=float, device="cpu")
    arrays = [wp.array(edges.astype(np.float32), dtype=wp.vec4, device="cpu")]
    arrays += [wp.array(middles.astype(np.float32), dtype=wp.vec2, device="cpu"), side / 2, reach]
    arrays += [wp.array(joined, dtype=wp.vec4, device="cpu"), wp.array(sizes, dtype=int, device="cpu"), found]
    wp.launch(look, found.shape, arrays, device="cpu")
    return found.numpy()
