"""Warp kernels of shortest paths over the cells of a grid, which are numbered row by row, and of straight lines."""

from __future__ import annotations

from rover_rl.native.warp import wp

BUCKETS = wp.constant(64)
"""Number of buckets of the queue. The cost of a step must be below ``BUCKETS - 1``."""


@wp.func
def unlink(cell: int, bucket: int, heads: wp.array[int], following: wp.array[int], preceding: wp.array[int]):
    """Removes a cell from the doubly linked list of its bucket. -1 ends a list."""
    after = following[cell]
    before = preceding[cell]
    if before >= 0:
        following[before] = after
    else:
        heads[bucket] = after
    if after >= 0:
        preceding[after] = before


@wp.func
def link(cell: int, bucket: int, heads: wp.array[int], following: wp.array[int], preceding: wp.array[int]):
    """Adds a cell at the head of the list of a bucket."""
    head = heads[bucket]
    following[cell] = head
    preceding[cell] = -1
    if head >= 0:
        preceding[head] = cell
    heads[bucket] = cell


@wp.kernel
def spread_costs(
    all_weights: wp.array2d[float],
    all_steps: wp.array2d[wp.uint32],
    all_open: wp.array2d[wp.bool],
    all_offsets: wp.array2d[int],
    lengths: wp.array[float],
    grids: wp.array[int],
    sources: wp.array[int],
    costs: wp.array2d[float],
    heads: wp.array2d[int],
    following: wp.array2d[int],
    preceding: wp.array2d[int],
    arrivals: wp.array2d[int],
    first_row: int,
):
    """Costs of the shortest paths from all cells of a grid to one: row ``t`` does so in ``grids[t]`` to ``sources[t]``.

    A step costs its length in cells times the mean weight of its two ends. Dijkstra's algorithm with a circular queue
    of buckets. A bucket holds the cells whose costs have the same whole part (E. V. Denardo and B. L. Fox,
    "Shortest-route methods: 1. Reaching, pruning, and buckets", Operations Research 27, 1979). As no step costs less
    than 1, no cell of the first bucket can improve another one in it.

    In open surroundings, a shortest path consists of steps in two neighboring directions, so that a path that arrives
    in an open cell by step k goes on by step k - 1, k or k + 1.

    A cell has a weight of at least 1, or 0 if it is not passable, and free steps as bits in the order of their
    directions. It is open if all steps are free and all weights are 1 around. Offsets are the differences of the cell
    numbers at the ends of each step, ``lengths`` are in cells. ``costs [sources, cells]`` are filled with
    infinity, ``heads [sources, BUCKETS]``, the first cell of each bucket, with -1. ``following``, ``preceding`` and
    ``arrivals``, the last step of the path to each cell, are working memory, ``[sources, cells]``.
    """
    t = first_row + wp.tid()
    weights = all_weights[grids[t]]
    steps = all_steps[grids[t]]
    is_open = all_open[grids[t]]
    offsets = all_offsets[grids[t]]
    first = heads[t]
    after = following[t]
    before = preceding[t]
    arrive = arrivals[t]
    cost = costs[t]
    cost[sources[t]] = 0.0
    link(sources[t], 0, first, after, before)
    whole = int(0)
    empty = int(0)
    while empty < BUCKETS:
        bucket = whole % BUCKETS
        if first[bucket] < 0:
            whole += 1
            empty += 1
        else:
            empty = int(0)
            cell = first[bucket]
            unlink(cell, bucket, first, after, before)
            # Settled: no other path to the cell is shorter.
            here = cost[cell]
            weight = weights[cell]
            free = steps[cell]
            k = int(0)
            end = offsets.shape[0]
            if is_open[cell] and cell != sources[t]:
                # As step numbers wrap around, the step before is count - 1 ahead.
                k = arrive[cell] + end - 1
                end = k + 3
            while k < end:
                step = k % offsets.shape[0]
                if ((free >> wp.uint32(step)) & wp.uint32(1)) == wp.uint32(1):
                    other = cell + offsets[step]
                    known = cost[other]
                    # No weight is below 1.
                    if here + 0.5 * lengths[step] * (weight + 1.0) < known:
                        candidate = here + 0.5 * lengths[step] * (weight + weights[other])
                        if candidate < known:
                            if known < wp.inf:
                                unlink(other, int(known) % BUCKETS, first, after, before)
                            cost[other] = candidate
                            arrive[other] = step
                            link(other, int(candidate) % BUCKETS, first, after, before)
                k += 1


@wp.func
def next_border(at: wp.float64, span: wp.float64):
    """First border of cells that a line crosses along an axis, from ``at`` in the direction of ``span``."""
    half = wp.float64(0.5)
    if span > wp.float64(0.0):
        return wp.floor(at + half) + half
    return wp.ceil(at - half) - half


@wp.func
def crossing(border: wp.float64, at: wp.float64, span: wp.float64):
    """Share of a line at which it crosses a border; more than 1 if it never does."""
    if span == wp.float64(0.0):
        return wp.float64(2.0)
    return (border - at) / span


@wp.kernel
def see(
    fits: wp.array2d[wp.uint32],
    begins: wp.array[wp.vec2d],
    ends: wp.array[wp.vec2d],
    orientations: wp.array[int],
    free: wp.array[wp.bool],
    first_row: int,
):
    """Whether the rover may drive straight from one point to another: in all cells between, its orientation fits.

    Coordinates are in cells, whose centers are whole numbers. ``fits`` has a margin of one cell.
    """
    row = first_row + wp.tid()
    begin = begins[row]
    span = ends[row] - begin
    # Shares of the line at which it crosses the next border of cells along x and y.
    border = wp.vec2d(next_border(begin[0], span[0]), next_border(begin[1], span[1]))
    last = wp.float64(0.0)
    one, half = wp.float64(1.0), wp.float64(0.5)
    free[row] = True
    while last < one:
        x, y = crossing(border[0], begin[0], span[0]), crossing(border[1], begin[1], span[1])
        share = wp.min(wp.min(x, y), one)
        if share - last >= wp.float64(1.0e-9):
            middle = begin + (share + last) * half * span
            column = wp.clamp(int(wp.floor(middle[0] + half)) + 1, 0, fits.shape[1] - 1)
            line = wp.clamp(int(wp.floor(middle[1] + half)) + 1, 0, fits.shape[0] - 1)
            if ((fits[line, column] >> wp.uint32(orientations[row])) & wp.uint32(1)) == wp.uint32(0):
                free[row] = False
                return
        if x <= share:
            border[0] = border[0] + wp.sign(span[0])
        if y <= share:
            border[1] = border[1] + wp.sign(span[1])
        last = share
