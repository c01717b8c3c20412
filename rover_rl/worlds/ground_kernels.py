"""Warp kernels over the ground and the obstacles of a world."""

from __future__ import annotations

import torch
from torch import Tensor

from rover_rl.native.warp import launch_rows, stream_of, wp
from rover_rl.worlds.terrain import Terrain, TerrainRows


@wp.struct
class Grounds:
    """Terrains of the rows: see :class:`~rover_rl.worlds.terrain.TerrainRows`."""

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


def ground_of(terrain: Terrain) -> Grounds:
    """Returns a terrain as that of row 0."""
    slot = torch.zeros(1, dtype=torch.int64)
    return grounds_of(TerrainRows(terrain.heights.reshape(1, -1), slot, terrain.grid[None]))


def measured_at(terrains: TerrainRows, xy: Tensor) -> Tensor:
    """Returns what :meth:`TerrainRows.height_at` does, as float32 and faster: ``[N, ...]``, m."""
    points = xy.float().reshape(len(xy), -1, 2).contiguous()
    heights = points.new_empty(points.shape[:2])
    with wp.ScopedStream(stream_of(points.device)):
        inputs = [grounds_of(terrains), wp.from_torch(points, dtype=wp.vec2), wp.from_torch(heights)]
        launch_rows(measure_heights, heights.shape, inputs, points.device)
    return heights.view(xy.shape[:-1])


@wp.func
def plane_at(grounds: Grounds, row: int, x: wp.float64, y: wp.float64) -> wp.vec3d:
    """Height (m) and slopes along x and y of the terrain's triangle at a point, as :meth:`Terrain.height_at`."""
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
        height = far - (one - u) * (far - left) - (one - v) * (far - right)
        return wp.vec3d(height, (far - left) / cell, (far - right) / cell)
    near = wp.float64(grounds.heights[slot, corner])
    return wp.vec3d(near + u * (right - near) + v * (left - near), (right - near) / cell, (left - near) / cell)


@wp.func
def height_at(grounds: Grounds, row: int, x: wp.float64, y: wp.float64) -> float:
    """Height of the ground, m."""
    return float(plane_at(grounds, row, x, y)[0])


@wp.kernel
def measure_heights(grounds: Grounds, points: wp.array2d[wp.vec2], heights: wp.array2d[float], first: int):
    """Height of the ground (m) at each point of each row (m)."""
    t, point = wp.tid()
    row = first + t
    at = points[row, point]
    heights[row, point] = height_at(grounds, row, wp.float64(at[0]), wp.float64(at[1]))


@wp.kernel
def measure_extremes(
    ground: Grounds,
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
            height = plane_at(ground, 0, start[0] + wp.float64(i) * spacing[0], start[1] + wp.float64(j) * spacing[1])
            least = wp.min(least, height[0])
            greatest = wp.max(greatest, height[0])
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
    boxes: wp.array[wp.vec4d],
    limit: wp.float64,
    clearance: wp.array2d[wp.float64],
):
    """Distances (m) from cells to the nearest of several convex polygons; thread ``j`` does row j.

    ``starts`` are the indices of each polygon's first vertex among ``outlines``, counter-clockwise, and the number of
    all. ``boxes`` (least x and y, greatest x and y) are around each. On input, ``clearance`` is ``limit``, the largest
    distance of interest.
    """
    j = wp.tid()
    y = ys[j]
    cell = xs[1] - xs[0]
    for n in range(boxes.shape[0]):
        box = boxes[n]
        off_y = wp.max(box[1] - y, y - box[3])
        if off_y < limit:
            off_y = wp.max(off_y, wp.float64(0.0))
            first = wp.max(int(wp.ceil((box[0] - limit - xs[0]) / cell)), 0)
            last = wp.min(int(wp.floor((box[2] + limit - xs[0]) / cell)), xs.shape[0] - 1)
            for i in range(first, last + 1):
                off_x = wp.max(wp.max(box[0] - xs[i], xs[i] - box[2]), wp.float64(0.0))
                # The distance to the box is a lower bound, but for rounding: most polygons are not the nearest one.
                bound = clearance[j, i] + wp.float64(1.0e-9)
                if off_x * off_x + off_y * off_y < bound * bound:
                    distance = distance_to_outline(xs[i], y, outlines, starts[n], starts[n + 1])
                    clearance[j, i] = wp.min(clearance[j, i], distance)


@wp.kernel
def measure_distances(mesh: wp.uint64, points: wp.array[wp.vec3], distances: wp.array[float]):
    """Distance of each point from the nearest triangle of a mesh, m."""
    k = wp.tid()
    nearest = wp.mesh_query_point_no_sign(mesh, points[k], 1.0e6)
    distances[k] = wp.length(wp.mesh_eval_position(mesh, nearest.face, nearest.u, nearest.v) - points[k])


@wp.kernel
def measure_rays(mesh: wp.uint64, points: wp.array[wp.vec3], distances: wp.array[float], direction: wp.vec3):
    """Distance from each point to a mesh along a direction, m, NaN if the ray meets no triangle."""
    k = wp.tid()
    hit = wp.mesh_query_ray(mesh, points[k], direction, 1.0e6)
    distances[k] = wp.where(hit.result, hit.t, wp.nan)
