"""Warp kernels that add lidar scans to maps of seen obstacles.

A map is a window of ``SIZE x SIZE`` cells around the rover, which moves with it cell by cell. Cell (X, Y) of the world
covers ``CELL * [X, X + 1)`` by ``CELL * [Y, Y + 1)``, m. It is stored at ``(Y mod SIZE) * SIZE + X mod SIZE``, so that
nothing moves in memory when the window does: only the cells that enter are cleared.
"""

from __future__ import annotations

from rover_rl.sims.native.warp import wp

SIZE = wp.constant(128)
"""Number of cells along a side of the window. A power of two."""
HALF = wp.constant(64)
"""Number of cells on each side of the rover's."""
LAST = wp.constant(127)
"""Bits of a cell number that its address depends on."""
CELL = wp.constant(0.15)
"""Side length of a cell, m. A gap of 0.7 m, in which the rover fits, has at least three free cells side by side."""
HIT = wp.constant(4)
"""Evidence that a reading adds to the cell at its end, and from which on a cell counts as occupied."""
MOST = wp.constant(12)
"""Largest evidence of a cell. Each beam that passes through it takes 1 away."""
RINGS = wp.constant(4)
"""Number of rings that are told apart around an occupied cell: 0 is the cell itself, ``RINGS`` is farther than 3."""
NO_GAP = wp.constant(4.0)
"""Distance between the ends of neighboring beams up to which nothing fits between them, cells: 0.6 m."""
LOWEST = wp.constant(-0.2)
"""Height of the end of a beam, relative to the lidar, below which it is on the ground, m."""


@wp.func
def address(x: int, y: int):
    """Returns where cell (x, y) of the world is stored."""
    return (y & LAST) * SIZE + (x & LAST)


@wp.func
def cell_of(position: float):
    """Returns the number of the cell that holds a coordinate, m."""
    return int(wp.floor(position / CELL))


@wp.func
def in_window(x: int, y: int, center: wp.vec2i):
    """Returns whether cell (x, y) of the world is in the window around a cell."""
    across = x - center[0] + HALF
    up = y - center[1] + HALF
    return across >= 0 and up >= 0 and across < SIZE and up < SIZE


@wp.func
def mark(x: int, y: int, center: wp.vec2i, evidence: wp.array[wp.uint8], rings: wp.array[wp.uint8]):
    """Adds a hit to a cell. If that makes it occupied, the rings of its surroundings shrink."""
    here = address(x, y)
    before = int(evidence[here])
    evidence[here] = wp.uint8(wp.min(before + HIT, MOST))
    if before < HIT:
        for dy in range(1 - RINGS, RINGS):
            for dx in range(1 - RINGS, RINGS):
                ring = wp.max(wp.abs(dx), wp.abs(dy))
                there = address(x + dx, y + dy)
                if in_window(x + dx, y + dy, center) and ring < int(rings[there]):
                    rings[there] = wp.uint8(ring)


@wp.func
def ring_at(x: int, y: int, center: wp.vec2i, evidence: wp.array[wp.uint8]):
    """Returns the distance of a cell from the nearest occupied one, at most ``RINGS``, in cells (Chebyshev)."""
    nearest = int(RINGS)
    for dy in range(1 - RINGS, RINGS):
        for dx in range(1 - RINGS, RINGS):
            if in_window(x + dx, y + dy, center) and int(evidence[address(x + dx, y + dy)]) >= HIT:
                nearest = wp.min(nearest, wp.max(wp.abs(dx), wp.abs(dy)))
    return nearest


@wp.func
def clear(x: int, y: int, center: wp.vec2i, evidence: wp.array[wp.uint8], rings: wp.array[wp.uint8]):
    """Takes evidence from a cell that a beam has passed. If that frees it, the rings around it are computed again."""
    here = address(x, y)
    before = int(evidence[here])
    if before > 0:
        evidence[here] = wp.uint8(before - 1)
        if before == HIT:
            for dy in range(1 - RINGS, RINGS):
                for dx in range(1 - RINGS, RINGS):
                    if in_window(x + dx, y + dy, center):
                        rings[address(x + dx, y + dy)] = wp.uint8(ring_at(x + dx, y + dy, center, evidence))


@wp.func
def move_window(before: wp.vec2i, after: wp.vec2i, evidence: wp.array[wp.uint8], rings: wp.array[wp.uint8]):
    """Clears the columns and rows that enter the window. What moves by more than its size is cleared as a whole."""
    for axis in range(2):
        shift = after[axis] - before[axis]
        count = wp.min(wp.abs(shift), SIZE)
        for k in range(count):
            entered = wp.where(shift > 0, after[axis] + HALF - 1 - k, after[axis] - HALF + k) & LAST
            for other in range(SIZE):
                cell = wp.where(axis == 0, other * SIZE + entered, entered * SIZE + other)
                evidence[cell] = wp.uint8(0)
                rings[cell] = wp.uint8(RINGS)


@wp.kernel
def add_scans(
    poses: wp.array2d[float],
    readings: wp.array2d[float],
    directions: wp.array[wp.vec2],
    mount: float,
    max_range: float,
    added: wp.array[wp.bool],
    renewed: wp.array[wp.bool],
    centers: wp.array[wp.vec2i],
    evidences: wp.array2d[wp.uint8],
    rings: wp.array2d[wp.uint8],
):
    """Adds a scan to each row's map; thread ``i`` does row i.

    A beam at the angle a in the frame of the lidar has the direction ``Rz(yaw) Ry(pitch) Rx(roll) (cos a, sin a, 0)``
    in the world's frame.

    Args:
        poses: x, y (m), pitch, roll and yaw (rad) of the rovers, ``[N, 5]``.
        readings: lidar readings, ``[N, P]``, m.
        directions: cosine and sine of the angle of each reading in the frame of the lidar, ``[P]``.
        mount: x of the lidar in the frame of the rover, m.
        max_range: range at which a beam has hit nothing, m.
        added: rows whose scan is added. The others do not change.
        renewed: rows whose map is cleared first.
        centers: cells in the middle of the windows; updated.
        evidences: evidence of an obstacle in each cell, ``[N, SIZE * SIZE]``; updated.
        rings: distance of each cell from the nearest occupied one, in cells, at most ``RINGS``; updated.
    """
    i = wp.tid()
    if not added[i]:
        return
    evidence = evidences[i]
    ring = rings[i]
    center = wp.vec2i(cell_of(poses[i, 0]), cell_of(poses[i, 1]))
    before = centers[i]
    if renewed[i]:
        before = center + wp.vec2i(SIZE, SIZE)
    move_window(before, center, evidence, ring)
    centers[i] = center
    cos_yaw = wp.cos(poses[i, 4])
    sin_yaw = wp.sin(poses[i, 4])
    cos_pitch = wp.cos(poses[i, 2])
    sin_pitch = wp.sin(poses[i, 2])
    cos_roll = wp.cos(poses[i, 3])
    sin_roll = wp.sin(poses[i, 3])
    # Position of the lidar, in cells.
    x = (poses[i, 0] + mount * cos_yaw) / CELL
    y = (poses[i, 1] + mount * sin_yaw) / CELL
    count = directions.shape[0]
    # First the cells that the beams pass, then those at their ends: a beam must not clear what another one has hit.
    for stage in range(2):
        seen = bool(False)
        last_x = float(0.0)
        last_y = float(0.0)
        # The last reading is a neighbor of the first one.
        for p in range(-1, count):
            k = wp.where(p < 0, count - 1, p)
            along = directions[k][0]
            aside = directions[k][1]
            forward = along * cos_pitch + aside * sin_roll * sin_pitch
            left = aside * cos_roll
            up = aside * sin_roll * cos_pitch - along * sin_pitch
            reading = readings[i, k]
            step_x = reading / CELL * (forward * cos_yaw - left * sin_yaw)
            step_y = reading / CELL * (forward * sin_yaw + left * cos_yaw)
            # Cells that the beam crosses along the axis along which it crosses more.
            crossed = wp.max(wp.abs(step_x), wp.abs(step_y))
            if stage == 0:
                if p >= 0 and crossed > 0.0:
                    for n in range(int(wp.min(crossed - 1.5, float(HALF - 2)))):
                        part = float(n + 1) / crossed
                        clear(
                            int(wp.floor(x + part * step_x)), int(wp.floor(y + part * step_y)), center, evidence, ring
                        )
            else:
                hit = reading < max_range and crossed < float(HALF - 2) and reading * up > LOWEST
                end_x = x + step_x
                end_y = y + step_y
                if hit and p >= 0:
                    mark(int(wp.floor(end_x)), int(wp.floor(end_y)), center, evidence, ring)
                    apart = wp.max(wp.abs(end_x - last_x), wp.abs(end_y - last_y))
                    if seen and wp.length(wp.vec2(end_x - last_x, end_y - last_y)) < NO_GAP:
                        for n in range(int(wp.ceil(apart)) - 1):
                            part = float(n + 1) / wp.ceil(apart)
                            between_x = int(wp.floor(last_x + part * (end_x - last_x)))
                            between_y = int(wp.floor(last_y + part * (end_y - last_y)))
                            if int(evidence[address(between_x, between_y)]) < HIT:
                                mark(between_x, between_y, center, evidence, ring)
                seen = hit
                last_x = end_x
                last_y = end_y
