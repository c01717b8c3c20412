"""Warp kernels over the ground and the obstacles of a world."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rover_rl.native.warp import wp
from rover_rl.worlds.terrain import Terrain

if TYPE_CHECKING:
    from rover_rl.worlds.table import TerrainRows


@wp.struct
class Ground:
    """Heights of a terrain: see :class:`Terrain`."""

    heights: wp.array2d[float]
    origin: wp.vec2d
    cell: wp.float64


def ground_of(terrain: Terrain) -> Ground:
    """Returns a terrain as a struct of the kernels."""
    ground = Ground()
    ground.heights = wp.from_numpy(terrain.heights.numpy(), dtype=float, device="cpu")
    ground.origin, ground.cell = wp.vec2d(*terrain.origin), terrain.cell
    return ground


@wp.struct
class Grounds:
    """Terrains of the rows: see :class:`~rover_rl.worlds.table.TerrainRows`."""

    heights: wp.array2d[float]
    slots: wp.array[wp.int64]
    # x and y of the first height, spacing, m; numbers of rows and columns.
    grids: wp.array2d[wp.float64]


def grounds_of(terrains: TerrainRows) -> Grounds:
    """Returns the terrains of rows as a struct of the kernels, in the same memory."""
    grounds = Grounds()
    grounds.heights, grounds.grids = wp.from_torch(terrains.heights), wp.from_torch(terrains.grids)
    grounds.slots = wp.from_torch(terrains.slots)
    return grounds


@wp.func
def height_at(grounds: Grounds, row: int, x: wp.float64, y: wp.float64) -> float:
    """Height of the ground (m), on two triangles for each cell of the grid: see :meth:`Terrain.height_at`."""
    one = wp.float64(1.0)
    zero = wp.float64(0.0)
    cell = grounds.grids[row, 2]
    rows = int(grounds.grids[row, 3])
    columns = int(grounds.grids[row, 4])
    u = wp.clamp((x - grounds.grids[row, 0]) / cell, zero, wp.float64(columns - 1))
    v = wp.clamp((y - grounds.grids[row, 1]) / cell, zero, wp.float64(rows - 1))
    # The lower limits keep the index of NaN on the grid.
    i = wp.max(wp.min(int(u), columns - 2), 0)
    j = wp.max(wp.min(int(v), rows - 2), 0)
    u = u - wp.float64(i)
    v = v - wp.float64(j)
    slot = int(grounds.slots[row])
    corner = j * columns + i
    right = wp.float64(grounds.heights[slot, corner + 1])
    left = wp.float64(grounds.heights[slot, corner + columns])
    if u + v > one:
        far = wp.float64(grounds.heights[slot, corner + columns + 1])
        return float(far - (one - u) * (far - left) - (one - v) * (far - right))
    near = wp.float64(grounds.heights[slot, corner])
    return float(near + u * (right - near) + v * (left - near))


@wp.kernel
def measure_heights(grounds: Grounds, points: wp.array2d[wp.vec2], heights: wp.array2d[float]):
    """Height of the ground (m) at each point of each row (m)."""
    row, point = wp.tid()
    at = points[row, point]
    heights[row, point] = height_at(grounds, row, wp.float64(at[0]), wp.float64(at[1]))


@wp.func
def plane_at(ground: Ground, x: wp.float64, y: wp.float64) -> wp.vec3d:
    """Height (m) and slopes along x and y of the terrain's triangle at a point, as :meth:`Terrain.height_at`."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    rows = ground.heights.shape[0]
    columns = ground.heights.shape[1]
    u = wp.clamp((x - ground.origin[0]) / ground.cell, zero, wp.float64(columns - 1))
    v = wp.clamp((y - ground.origin[1]) / ground.cell, zero, wp.float64(rows - 1))
    i = wp.min(int(u), columns - 2)
    j = wp.min(int(v), rows - 2)
    u = u - wp.float64(i)
    v = v - wp.float64(j)
    h10 = wp.float64(ground.heights[j, i + 1])
    h01 = wp.float64(ground.heights[j + 1, i])
    if u + v > one:
        h11 = wp.float64(ground.heights[j + 1, i + 1])
        rise_x = h11 - h01
        rise_y = h11 - h10
        return wp.vec3d(h11 - (one - u) * rise_x - (one - v) * rise_y, rise_x / ground.cell, rise_y / ground.cell)
    h00 = wp.float64(ground.heights[j, i])
    rise_x = h10 - h00
    rise_y = h01 - h00
    return wp.vec3d(h00 + u * rise_x + v * rise_y, rise_x / ground.cell, rise_y / ground.cell)


@wp.kernel
def measure_extremes(
    ground: Ground,
    lows: wp.array[wp.vec2d],
    highs: wp.array[wp.vec2d],
    steps: wp.array[int],
    extremes: wp.array[wp.vec2d],
):
    """Least and greatest height at ``steps`` x ``steps`` samples of a rectangle, m; thread ``t`` does rectangle t."""
    t = wp.tid()
    start = lows[t]
    spacing = (highs[t] - start) / wp.float64(steps[t] - 1)
    least = wp.float64(wp.inf)
    greatest = wp.float64(-wp.inf)
    for j in range(steps[t]):
        for i in range(steps[t]):
            height = plane_at(ground, start[0] + wp.float64(i) * spacing[0], start[1] + wp.float64(j) * spacing[1])[0]
            least = wp.min(least, height)
            greatest = wp.max(greatest, height)
    extremes[t] = wp.vec2d(least, greatest)


@wp.func
def distance_to_outline(x: wp.float64, y: wp.float64, outlines: wp.array[wp.vec2d], start: int, end: int) -> wp.float64:
    """Distance of a point to a convex polygon with counter-clockwise vertices, 0 inside of it."""
    nearest = wp.float64(wp.inf)
    inside = bool(True)
    for k in range(start, end):
        a = outlines[k]
        b = outlines[wp.where(k + 1 == end, start, k + 1)]
        edge_x = b[0] - a[0]
        edge_y = b[1] - a[1]
        off_x = x - a[0]
        off_y = y - a[1]
        along = wp.clamp(
            (off_x * edge_x + off_y * edge_y) / (edge_x * edge_x + edge_y * edge_y), wp.float64(0.0), wp.float64(1.0)
        )
        rest_x = off_x - along * edge_x
        rest_y = off_y - along * edge_y
        nearest = wp.min(nearest, rest_x * rest_x + rest_y * rest_y)
        if edge_x * off_y - edge_y * off_x < wp.float64(0.0):
            inside = False
    return wp.where(inside, wp.float64(0.0), wp.sqrt(nearest))


@wp.kernel
def measure_clearance(
    xs: wp.array[wp.float64],
    ys: wp.array[wp.float64],
    outlines: wp.array[wp.vec2d],
    starts: wp.array[int],
    circles: wp.array[wp.vec3d],
    limit: wp.float64,
    clearance: wp.array2d[wp.float64],
):
    """Distances (m) from cells to the nearest of several convex polygons; thread ``j`` does row j.

    ``outlines`` are the vertices of all polygons, counter-clockwise, and ``starts`` the index of each polygon's first
    vertex, and the number of all. ``circles`` are the center and the radius of a circle around each polygon. On input,
    ``clearance`` is ``limit``, the largest distance of interest.
    """
    j = wp.tid()
    y = ys[j]
    cell = xs[1] - xs[0]
    for n in range(circles.shape[0]):
        circle = circles[n]
        reach = limit + circle[2]
        if wp.abs(circle[1] - y) < reach:
            first = wp.max(int(wp.ceil((circle[0] - reach - xs[0]) / cell)), 0)
            last = wp.min(int(wp.floor((circle[0] + reach - xs[0]) / cell)), xs.shape[0] - 1)
            for i in range(first, last + 1):
                off_x = xs[i] - circle[0]
                off_y = y - circle[1]
                # The circle is a lower bound of the distance: most polygons are not the nearest one.
                bound = clearance[j, i] + circle[2]
                if off_x * off_x + off_y * off_y < bound * bound:
                    distance = distance_to_outline(xs[i], y, outlines, starts[n], starts[n + 1])
                    clearance[j, i] = wp.min(clearance[j, i], distance)
