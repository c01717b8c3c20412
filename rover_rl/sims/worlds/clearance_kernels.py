"""Warp kernels that measure the distance to obstacles on a grid."""

from __future__ import annotations

from rover_rl.sims.native.warp import wp


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
    """Distances from the centers of cells to the nearest of several convex polygons; thread ``j`` does row j.

    Args:
        xs: x of each column, at equal distances, m.
        ys: y of each row, m.
        outlines: vertices of all polygons, counter-clockwise, m.
        starts: index of each polygon's first vertex, and the number of all vertices.
        circles: center and radius of a circle around each polygon, m.
        limit: largest distance of interest, m.
        clearance: results, m, ``[rows, columns]``; on input the limit.
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
