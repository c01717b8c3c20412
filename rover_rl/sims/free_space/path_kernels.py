"""Warp kernels of shortest paths over the cells of a grid.

Cells are numbered row by row. Costs are in cells: a step costs its length times the mean weight of its two
ends, and weights are at least 1. A path may leave a cell in 32 directions: the steps of
:mod:`rover_rl.sims.free_space.path_steps`.
"""

from __future__ import annotations

from rover_rl.sims.native.warp import wp

BUCKETS = wp.constant(64)
"""Number of buckets of the queue. The cost of a step must be below ``BUCKETS - 1``."""
ALL = wp.constant(wp.uint32(0xFFFFFFFF))
"""Mask with all 32 steps."""
OPEN = wp.constant(2)
"""Value of cells in whose surroundings all steps are free and all weights are 1."""
FREE = wp.constant(1)
"""Value of cells from which all steps are free."""


@wp.kernel
def find_steps(
    fits: wp.array2d[wp.uint32],
    openness: wp.array2d[int],
    orientations: wp.array[int],
    crossed: wp.array[wp.vec2i],
    crossed_starts: wp.array[int],
    steps: wp.array2d[wp.uint32],
):
    """Finds the steps that are free from each cell; thread ``j`` does row j.

    Bit k of ``steps`` is set if the orientation of step k is free in all cells that the step runs through.

    Args:
        fits: free orientations of each cell, as bits; 0 if the cell is not passable.
        openness: ``FREE`` or ``OPEN`` if all steps are free from a cell, else 0.
        orientations: orientation of each step.
        crossed: cells that each step runs through, relative to its first cell.
        crossed_starts: index of the first crossed cell of each step, and the number of all.
        steps: results.
    """
    j = wp.tid()
    for i in range(fits.shape[1]):
        bits = wp.uint32(0)
        if openness[j, i] > 0:
            bits = ALL
        elif fits[j, i] != wp.uint32(0):
            for k in range(orientations.shape[0]):
                bit = wp.uint32(1) << wp.uint32(orientations[k])
                free = bool(True)
                for n in range(crossed_starts[k], crossed_starts[k + 1]):
                    column = i + crossed[n][0]
                    row = j + crossed[n][1]
                    if row < 0 or column < 0 or row >= fits.shape[0] or column >= fits.shape[1]:
                        free = False
                    # Kernels evaluate both sides of "or", so that one condition would read outside of the grid.
                    elif (fits[row, column] & bit) == wp.uint32(0):
                        free = False
                if free:
                    bits = bits | (wp.uint32(1) << wp.uint32(k))
        steps[j, i] = bits


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
    weights: wp.array[float],
    steps: wp.array[wp.uint32],
    openness: wp.array[int],
    offsets: wp.array[int],
    lengths: wp.array[float],
    sources: wp.array[int],
    costs: wp.array2d[float],
    heads: wp.array2d[int],
    following: wp.array2d[int],
    preceding: wp.array2d[int],
    arrivals: wp.array2d[int],
):
    """Costs of the shortest paths from all cells to one cell; thread ``t`` does so for the cell ``sources[t]``.

    Dijkstra's algorithm with a circular queue of buckets. A bucket holds the cells whose costs have the same whole part
    (E. V. Denardo and B. L. Fox, "Shortest-route methods: 1. Reaching, pruning, and buckets", Operations Research 27,
    1979). As no step costs less than 1, no cell of the first bucket can improve another one in it.

    In open surroundings, a shortest path consists of steps in two neighboring directions, so that a path that arrives
    in an open cell by step k goes on by step k - 1, k or k + 1.

    Args:
        weights: weights of the cells; 0 for a cell that is not passable.
        steps: free steps of each cell, from :func:`find_steps`, in the order of their directions.
        openness: ``OPEN`` in cells in whose surroundings all steps are free and all weights are 1.
        offsets: difference of the cell numbers at the two ends of each step.
        lengths: lengths of the steps, in cells.
        sources: numbers of the cells at which the paths end.
        costs: results, ``[sources, cells]``, filled with infinity.
        heads: first cell of each bucket, ``[sources, BUCKETS]``, filled with -1.
        following: working memory, ``[sources, cells]``.
        preceding: working memory, ``[sources, cells]``.
        arrivals: working memory: last step of the path to each cell, ``[sources, cells]``.
    """
    t = wp.tid()
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
            if openness[cell] == OPEN and cell != sources[t]:
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
