"""Warp kernels over the cells of the free space: headings for the lidar and the footprint, and narrow passages.

Headings are numbered: heading k of 64 is the yaw ``2 pi k / 64 - pi``. An orientation is a heading without front and
back: orientation k of 32 stands for the headings k and k + 32, which are equal for a symmetric footprint.
"""

from __future__ import annotations

from rover_rl.sims.native.warp import wp

ALL = wp.constant(wp.uint32(0xFFFFFFFF))
"""Mask with all 32 orientations."""


@wp.func
def interpolate(
    values: wp.array2d[wp.float64], origin: wp.vec2d, cell: wp.float64, x: wp.float64, y: wp.float64
) -> wp.float64:
    """Interpolates a field at the points of a grid bilinearly. Beyond the grid, its edge counts."""
    rows = values.shape[0]
    columns = values.shape[1]
    u = wp.clamp((x - origin[0]) / cell, wp.float64(0.0), wp.float64(columns - 1))
    v = wp.clamp((y - origin[1]) / cell, wp.float64(0.0), wp.float64(rows - 1))
    i = wp.min(int(u), columns - 2)
    j = wp.min(int(v), rows - 2)
    u = u - wp.float64(i)
    v = v - wp.float64(j)
    one = wp.float64(1.0)
    lower = (one - u) * values[j, i] + u * values[j, i + 1]
    upper = (one - u) * values[j + 1, i] + u * values[j + 1, i + 1]
    return (one - v) * lower + v * upper


@wp.kernel
def find_headings(
    cells: wp.array[wp.vec2d],
    offsets: wp.array2d[wp.vec2d],
    rests: wp.array[wp.uint64],
    clearance: wp.array2d[wp.float64],
    origin: wp.vec2d,
    cell: wp.float64,
    least: wp.float64,
    headings: wp.array[wp.int64],
):
    """Finds the heading bins in which the lidar is far enough from all obstacles; thread ``t`` does cell ``t``.

    Bit k of ``headings`` is set if that holds at both ends of bin k, the headings k and k + 1 of 64.

    Args:
        cells: centers of the cells, m.
        offsets: position of the lidar relative to the rover at each of the 64 headings, m, for each cell or for all.
        rests: headings in which a rover may rest, for each cell or for all.
        clearance: distances to the nearest obstacle at the points of a grid, m, ``[rows, columns]``. Between them, the
            distance is interpolated bilinearly.
        origin: x, y of ``clearance[0, 0]``, m.
        cell: spacing of the grid, m.
        least: least distance of the lidar, m.
        headings: results.
    """
    t = wp.tid()
    own = wp.min(t, rests.shape[0] - 1)
    good = wp.uint64(0)
    for k in range(64):
        point = cells[t] + offsets[own, k]
        if interpolate(clearance, origin, cell, point[0], point[1]) >= least:
            good = good | (wp.uint64(1) << wp.uint64(k))
    good = good & rests[own]
    headings[t] = wp.int64(good & ((good >> wp.uint64(1)) | (good << wp.uint64(63))))


@wp.kernel
def fit_footprint(
    clearance: wp.array2d[wp.float64],
    cell: wp.float64,
    turning: wp.float64,
    discs: wp.array[wp.float64],
    radii: wp.array[wp.float64],
    yaws: wp.array[wp.vec2d],
    fits: wp.array2d[wp.uint32],
):
    """Finds the orientations in which the footprint at the center of a cell is free; thread ``j`` does row j.

    The footprint is covered by discs with the centers ``x_i (cos yaw, sin yaw)``, in pairs ``x_i`` and ``-x_i``. An
    orientation is free if the distance to the nearest obstacle is at least a disc's radius at the center of each disc.
    All orientations are free if the turning circle is.

    Args:
        clearance: distances to the nearest obstacle at the centers of the cells, m, ``[rows, columns]``.
        cell: side length of a cell, m.
        turning: radius of the turning circle with its margin, m.
        discs: centers of the discs at x >= 0, the innermost first, m.
        radii: radii of the discs with their margins, m.
        yaws: cosine and sine of the 64 headings.
        fits: results. Bit k of a mask is orientation k.
    """
    j = wp.tid()
    for i in range(clearance.shape[1]):
        if clearance[j, i] >= turning:
            fits[j, i] = ALL
        elif clearance[j, i] < radii[0] - discs[0]:
            fits[j, i] = wp.uint32(0)
        else:
            both = ALL
            for n in range(discs.shape[0]):
                good = wp.uint64(0)
                for k in range(64):
                    x = wp.float64(i) * cell + discs[n] * yaws[k][0]
                    y = wp.float64(j) * cell + discs[n] * yaws[k][1]
                    if interpolate(clearance, wp.vec2d(), cell, x, y) >= radii[n]:
                        good = good | (wp.uint64(1) << wp.uint64(k))
                both = both & wp.uint32(good) & wp.uint32(good >> wp.uint64(32))
            fits[j, i] = both


@wp.func
def spread_turns(reached: wp.uint32, fits: wp.uint32) -> wp.uint32:
    """Adds the orientations that turns on the spot reach: those beside reached ones, as far as all between fit."""
    bits = wp.uint32(reached)
    one = wp.uint32(1)
    last = wp.uint32(31)
    more = bool(bits != wp.uint32(0))
    while more:
        grown = (bits | (bits << one) | (bits >> last) | (bits >> one) | (bits << last)) & fits
        more = grown != bits
        bits = grown
    return bits


@wp.func
def step_fits(
    fits: wp.array2d[wp.uint32], j: int, i: int, bit: wp.uint32, crossed: wp.array[wp.vec2i], first: int, last: int
) -> bool:
    """Whether an orientation fits in all cells ``crossed[first:last]``, relative to the cell in row j and column i."""
    for n in range(first, last):
        column = i + crossed[n][0]
        row = j + crossed[n][1]
        if row < 0 or column < 0 or row >= fits.shape[0] or column >= fits.shape[1]:
            return False
        # Kernels evaluate both sides of "or", so that a single condition would read outside of the grid.
        if (fits[row, column] & bit) == wp.uint32(0):
            return False
    return True


@wp.kernel
def join_parts(
    narrow: wp.array[wp.vec2i],
    fits: wp.array2d[wp.uint32],
    parts: wp.array2d[int],
    steps: wp.array[wp.vec2i],
    orientations: wp.array[int],
    crossed: wp.array[wp.vec2i],
    starts: wp.array[int],
    reached: wp.array2d[wp.uint32],
    joined: wp.array[int],
    done: wp.array[int],
):
    """Finds what a rover reaches from a part of the roomy cells through narrow cells. Runs as a single thread.

    A rover drives straight, forward or backward, from the center of a cell to that of another, where its orientation
    is that of the step and fits in all cells that the step crosses. It turns on the spot while all orientations
    between fit. Sweeps over the narrow cells repeat until nothing changes.

    Args:
        narrow: column and row of the narrow cells.
        fits: free orientations of all cells, from :func:`fit_footprint`; all in roomy cells.
        parts: number of the part of each roomy cell, 0 in other cells.
        steps: column and row of the other end of each step, relative to the first.
        orientations: orientation of each step.
        crossed: cells that each step crosses, without the first, relative to the first.
        starts: index of the first crossed cell of each step, and the number of all.
        reached: results: orientations in which the rover reaches each narrow cell; on input 0.
        joined: whether the rover reaches each part, 0 or 1; on input 1 for the part from which it starts.
        done: working memory for each narrow cell, on input 0.
    """
    changed = bool(True)
    count = narrow.shape[0]
    forward = bool(True)
    while changed:
        changed = bool(False)
        for m in range(count):
            n = wp.where(forward, m, count - 1 - m)
            i = narrow[n][0]
            j = narrow[n][1]
            free = fits[j, i]
            bits = wp.uint32(reached[j, i])
            if done[n] > 0:
                continue
            if bits == free:
                # This sweep joins the parts beside the cell, and nothing is left to do.
                done[n] = 1
            for k in range(steps.shape[0]):
                bit = wp.uint32(1) << wp.uint32(orientations[k])
                if (free & bit) != wp.uint32(0) and step_fits(fits, j, i, bit, crossed, starts[k], starts[k + 1]):
                    column = i + steps[k][0]
                    row = j + steps[k][1]
                    part = parts[row, column]
                    if part > 0:
                        if joined[part] > 0:
                            bits = bits | bit
                        elif (bits & bit) != wp.uint32(0):
                            joined[part] = 1
                            changed = bool(True)
                    else:
                        bits = bits | (reached[row, column] & bit)
            bits = spread_turns(bits, free)
            if bits != reached[j, i]:
                reached[j, i] = bits
                changed = bool(True)
        forward = not forward
