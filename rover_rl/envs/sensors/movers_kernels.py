"""Warp kernels on the movers around rovers: which of them come nearest, and the scans that they will give."""

from __future__ import annotations

from rover_rl.native.warp import wp

MOST = wp.constant(12)
"""Largest number of movers that are put in order."""
Distances = wp.types.vector(length=MOST, dtype=wp.float32)
Numbers = wp.types.vector(length=MOST, dtype=wp.int32)


@wp.func
def length_of(vector: wp.vec2) -> float:
    """Length of a vector. Of the squares, the first one is rounded, as in PyTorch's norm on the CPU."""
    y = wp.float64(vector[1])
    return wp.sqrt(float(wp.float64(vector[0] * vector[0]) + y * y))


@wp.func
def along(heading: wp.vec2, vector: wp.vec2) -> wp.vec2:
    """Turns a vector of the world into a frame whose x axis is ``heading``, a unit vector."""
    x = heading[0] * vector[0] + heading[1] * vector[1]
    return wp.vec2(x, heading[0] * vector[1] - heading[1] * vector[0])


@wp.kernel
def put_in_order(
    positions: wp.array2d[wp.vec2], velocities: wp.array2d[wp.vec2], places: wp.array[wp.vec2],
    headings: wp.array[wp.vec2], radii: wp.array2d[float], exist: wp.array2d[wp.bool], rows: wp.array[wp.bool],
    found: wp.array3d[float], first: int,
):  # fmt: skip
    """Writes the movers of a row that come nearest in 0, 1 or 2 s, the nearest first: see ``sensors.movers``."""
    row = first + wp.tid()
    if not rows[row]:
        return
    most = found.shape[1]
    gaps = Distances()
    numbers = Numbers()
    count = int(0)
    for mover in range(positions.shape[1]):
        gap = float(wp.inf)
        if exist[row, mover]:
            place = along(headings[row], positions[row, mover] - places[row])
            velocity = along(headings[row], velocities[row, mover])
            for seconds in range(3):
                gap = wp.min(gap, length_of(place + float(seconds) * velocity))
            gap = gap - radii[row, mover]
        if count < most:
            count += 1
        elif gap >= gaps[most - 1]:
            continue
        k = int(count - 1)
        while k > 0 and gaps[wp.max(k - 1, 0)] > gap:
            gaps[k] = gaps[k - 1]
            numbers[k] = numbers[k - 1]
            k -= 1
        gaps[k] = gap
        numbers[k] = mover
    for k in range(most):
        for n in range(found.shape[2]):
            found[row, k, n] = 0.0
        if k < count:
            chosen = numbers[k]
            share = wp.where(exist[row, chosen], 1.0, 0.0)
            place = share * along(headings[row], positions[row, chosen] - places[row])
            velocity = share * along(headings[row], velocities[row, chosen])
            for axis in range(2):
                found[row, k, axis] = place[axis]
                found[row, k, 2 + axis] = velocity[axis]
            found[row, k, 4] = share * radii[row, chosen]


@wp.kernel
def predict_scans(
    rays: wp.array[wp.vec2], instants: wp.array[float], widening: float, farthest: float, movers: wp.array3d[float],
    rows: wp.array[wp.bool], scans: wp.array3d[float], first: int,
):  # fmt: skip
    """Writes the ranges of the movers of a row at later instants; rays become wider by ``widening`` for each meter."""
    row = first + wp.tid()
    if not rows[row]:
        return
    for instant in range(instants.shape[0]):
        for ray in range(rays.shape[0]):
            scans[row, instant, ray] = farthest
        for mover in range(movers.shape[1]):
            radius = movers[row, mover, 4]
            if radius != 0.0:
                velocity = wp.vec2(movers[row, mover, 2], movers[row, mover, 3])
                center = wp.vec2(movers[row, mover, 0], movers[row, mover, 1]) + instants[instant] * velocity
                distance = length_of(center)
                wide = radius + distance * widening
                near = wp.max(distance - radius, 0.0)
                for ray in range(rays.shape[0]):
                    beam = along(rays[ray], center)
                    if wp.abs(beam[1]) < wide and beam[0] > -radius:
                        scans[row, instant, ray] = wp.min(scans[row, instant, ray], near)
