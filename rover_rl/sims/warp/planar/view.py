"""What of a plan can be seen: edges that stick out of other obstacles, and those that are in view from a cell."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rover_rl.native.warp import wp
from rover_rl.worlds.solids import bounding_balls

CLEAR = 2.0e-3
"""Distance in front of an edge at which it is looked at: its own obstacle, and what touches it, is behind, m."""


@wp.struct
class Outlines:
    """Convex outlines of obstacles, counter-clockwise."""

    # Ends (ax, ay, bx, by) of the edges of all outlines, and the first edge of each outline.
    edges: wp.array[wp.vec4]
    starts: wp.array[int]
    # Circle (x, y, radius) around each outline, and its lowest and highest point, m.
    circles: wp.array[wp.vec3]
    spans: wp.array[wp.vec2]


@wp.func
def outward_of(edge: wp.vec4) -> wp.vec2:
    return wp.vec2(edge[3] - edge[1], edge[0] - edge[2])


@wp.func
def moved_out(edge: wp.vec4) -> wp.vec4:
    """An edge a little to its free side."""
    step = CLEAR * wp.normalize(outward_of(edge))
    return edge + wp.vec4(step[0], step[1], step[0], step[1])


@wp.func
def crosses(outlines: Outlines, number: int, a: wp.vec2, b: wp.vec2) -> bool:
    """Whether a segment meets an outline."""
    enters = float(0.0)
    leaves = float(1.0)
    for k in range(outlines.starts[number], outlines.starts[number + 1]):
        edge = outlines.edges[k]
        outward = outward_of(edge)
        height = wp.dot(outward, a - wp.vec2(edge[0], edge[1]))
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
def hides(outlines: Outlines, number: int, middle: wp.vec2, half: float, edge: wp.vec4) -> bool:
    """Whether an outline hides an edge from all of a square cell.

    It does if it meets the four segments from corners of the cell to each end of the edge. For if a segment from a
    point of the cell to one of the edge missed the outline, a line would separate the two convex sets; and on its side
    of the line there would be a corner of the cell and an end of the edge, and the segment between them.
    """
    # The segment between the middles passes by the circle: most outlines end here.
    circle = outlines.circles[number]
    along = 0.5 * wp.vec2(edge[0] + edge[2], edge[1] + edge[3]) - middle
    offset = wp.vec2(circle[0], circle[1]) - middle
    share = wp.clamp(wp.dot(offset, along) / wp.length_sq(along), 0.0, 1.0)
    if wp.length_sq(offset - share * along) > circle[2] * circle[2]:
        return False
    # A loop to a constant would be unrolled, which takes long to compile.
    pairs = int(8)
    for k in range(pairs):
        corner = middle + half * wp.vec2(wp.where(k & 1 == 0, -1.0, 1.0), wp.where(k & 2 == 0, -1.0, 1.0))
        target = wp.where(k < 4, wp.vec2(edge[0], edge[1]), wp.vec2(edge[2], edge[3]))
        if not crosses(outlines, number, corner, target):
            return False
    return True


@wp.func
def faces(edge: wp.vec4, middle: wp.vec2, radius: float, reach: float) -> bool:
    """Whether some point within a circle is on the free side of an edge and within ``reach`` (m) of it."""
    along = wp.vec2(edge[2], edge[3]) - wp.vec2(edge[0], edge[1])
    offset = middle - wp.vec2(edge[0], edge[1])
    square = wp.length_sq(along)
    ahead = wp.min(wp.dot(offset, outward_of(edge)), 0.0)
    if ahead * ahead > radius * radius * square:
        return False
    share = wp.clamp(wp.dot(offset, along) / square, 0.0, 1.0)
    return wp.length_sq(offset - share * along) <= (reach + radius) * (reach + radius)


@wp.kernel
def look(
    outlines: Outlines,
    edges: wp.array[wp.vec4],
    middles: wp.array[wp.vec2],
    half: float,
    reach: float,
    low: float,
    high: float,
    seen: wp.array2d[wp.bool],
):
    """Writes which edges are within ``reach`` (m) of a square cell, on their free side, and not hidden.

    Obstacles hide edges if they reach from the height ``low`` to ``high``, m; none does if ``low`` is above ``high``.
    """
    cell = wp.tid()
    middle = middles[cell]
    count = outlines.spans.shape[0]
    # What hides an edge often hides the next one.
    first = int(0)
    for number in range(edges.shape[0]):
        edge = edges[number]
        visible = faces(edge, middle, 1.41421356 * half, reach)
        if visible and low <= high:
            moved = moved_out(edge)
            for n in range(count):
                k = (first + n) % count
                span = outlines.spans[k]
                if span[0] < low and span[1] > high:
                    if hides(outlines, k, middle, half, moved):
                        visible = False
                        first = k
                        break
        seen[cell, number] = visible


@wp.kernel
def stick_out(outlines: Outlines, owners: wp.array[int], free: wp.array[wp.bool]):
    """Writes which edges do not lie within another obstacle that is as low and as high as their own."""
    number = wp.tid()
    owner = owners[number]
    edge = moved_out(outlines.edges[number])
    own = outlines.spans[owner]
    free[number] = True
    for k in range(outlines.spans.shape[0]):
        span = outlines.spans[k]
        if k != owner and span[0] <= own[0] and span[1] >= own[1]:
            deepest = float(-wp.inf)
            for n in range(outlines.starts[k], outlines.starts[k + 1]):
                other = outlines.edges[n]
                outward = outward_of(other)
                corner = wp.vec2(other[0], other[1])
                deepest = wp.max(deepest, wp.dot(outward, wp.vec2(edge[0], edge[1]) - corner))
                deepest = wp.max(deepest, wp.dot(outward, wp.vec2(edge[2], edge[3]) - corner))
            if deepest < 0.0:
                free[number] = False


@dataclass(frozen=True)
class Sight:
    """Obstacles that hide one another: convex outlines ``[K, 2]``, and lowest and highest points ``[N, 2]``, m."""

    outlines: list[np.ndarray]
    spans: np.ndarray

    @cached_property
    def _edges(self) -> tuple[np.ndarray, np.ndarray]:
        corners, starts = np.concatenate([np.empty((0, 2)), *self.outlines]), np.cumsum([0, *map(len, self.outlines)])
        after = np.arange(1, len(corners) + 1)
        after[starts[1:] - 1] = starts[:-1]
        return np.hstack((corners, corners[after])), starts

    def free_edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the edges that do not lie within another obstacle, ``[E, 4]``, and their obstacles ``[E]``."""
        edges, starts = self._edges
        owners = np.repeat(np.arange(len(self.outlines)), np.diff(starts))
        free = wp.empty(len(edges), dtype=wp.bool, device="cpu")
        wp.launch(stick_out, free.shape, [self._struct, _array(owners, int), free], device="cpu")
        kept = free.numpy() & (np.linalg.norm(edges[:, 2:] - edges[:, :2], axis=1) > 1e-6)
        return edges[kept], owners[kept]

    def edges_of(
        self, middles: np.ndarray, side: float, edges: np.ndarray, reach: float, heights: tuple[float, float]
    ) -> np.ndarray:
        """Returns which edges ``[E, 4]`` are within reach of square cells and not hidden from all of it, ``[C, E]``.

        See :func:`look`, of which ``heights`` are ``low`` and ``high``. Cells have ``middles [C, 2]``, m.
        """
        seen = wp.empty((len(middles), len(edges)), dtype=wp.bool, device="cpu")
        arrays = [_array(edges, wp.vec4), _array(middles, wp.vec2)]
        wp.launch(look, len(middles), [self._struct, *arrays, side / 2, reach, *heights, seen], device="cpu")
        return seen.numpy()

    @cached_property
    def _struct(self) -> Outlines:
        outlines, (edges, starts) = Outlines(), self._edges
        middles, radii = bounding_balls(edges[:, :2], starts) if len(edges) else (edges[:, :2], edges[:, 0])
        outlines.edges, outlines.starts = _array(edges, wp.vec4), _array(starts, int)
        outlines.circles = _array(np.column_stack((middles, radii)), wp.vec3)
        outlines.spans = _array(self.spans, wp.vec2)
        return outlines


def _array(values: np.ndarray, dtype: object) -> wp.array:
    return wp.array(values.astype(np.int32 if dtype is int else np.float32), dtype=dtype, device="cpu")
