"""Warp kernel that closes the ways of what moves on maps of seen obstacles."""

from __future__ import annotations

from rover_rl.envs.seen_map.scan_kernels import CROSSED, HALF, address
from rover_rl.native.warp import wp

STEPS = wp.constant(16)
"""Number of instants at which what moves is looked at."""
STEP_DT = wp.constant(0.25)
"""Time from one to the next, s."""
EARLY = wp.constant(0.75)
"""Time before and after the rover could be in a cell, in which the cell is closed, s."""
TIGHT = wp.constant(1)
"""Level that closed cells have in a plan: the rover does not fit there, but gets out if it is there."""


@wp.kernel
def close_ways(
    planned: wp.array[wp.bool],
    centers: wp.array[wp.vec2i],
    places: wp.array2d[float],
    ways: wp.array3d[float],
    speeds: wp.array[float],
    levels: wp.array2d[wp.uint8],
    closes: bool,
    first: int,
):
    """Closes the cells where the rover would meet what moves, or opens them again.

    Thread ``(t, m)`` does so for mover ``m`` of row ``first + t``. Threads of one row that write to the same cell write
    the same.

    Args:
        planned: rows to plan for.
        centers: cells in the middle of the windows.
        places: x and y of the rovers, ``[N, 2]``, in cells of the world, as all lengths here.
        ways: x, y, velocity along x and y (1/s), and radius of what moves, ``[N, K, 5]``. A negative one counts for
            nothing.
        speeds: speeds of the rovers, 1/s.
        levels: level of each cell, to which ``CROSSED`` is added in those that are closed.
        closes: whether to close the cells, or to open them again.
        first: first row.
    """
    t, m = wp.tid()
    i = t + first
    radius = ways[i, m, 4]
    if not planned[i] or radius <= 0.0:
        return
    center = centers[i]
    for n in range(STEPS):
        time = STEP_DT * float(n)
        x = ways[i, m, 0] + time * ways[i, m, 2]
        y = ways[i, m, 1] + time * ways[i, m, 3]
        # The rover can be in a ring around its place.
        inner = wp.max(time - EARLY, 0.0) * speeds[i]
        outer = (time + EARLY) * speeds[i]
        away = wp.length(wp.vec2(x - places[i, 0], y - places[i, 1]))
        if away - radius < outer and away + radius > inner:
            for row in range(int(wp.floor(y - radius)), int(wp.floor(y + radius)) + 1):
                v = float(row) + 0.5
                half = wp.sqrt(wp.max(radius * radius - (v - y) * (v - y), 0.0))
                # The cells whose middles are on the disc of the mover.
                for column in range(int(wp.ceil(x - half - 0.5)), int(wp.floor(x + half - 0.5)) + 1):
                    u = float(column) + 0.5
                    square = wp.length_sq(wp.vec2(u - places[i, 0], v - places[i, 1]))
                    in_window = wp.max(wp.abs(column - center[0]), wp.abs(row - center[1])) < HALF
                    if in_window and square > inner * inner and square < outer * outer:
                        cell = address(column, row)
                        level = int(levels[i, cell])
                        if closes and level > TIGHT and level < CROSSED:
                            levels[i, cell] = wp.uint8(level + CROSSED)
                        elif not closes and level >= CROSSED:
                            levels[i, cell] = wp.uint8(level - CROSSED)
