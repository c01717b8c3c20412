"""Warp kernel of :class:`~rover_rl.envs.sensors.visits.Visits`: adds to the times in a map, and reads them."""

from __future__ import annotations

from rover_rl.native.warp import wp


@wp.struct
class Corner:
    """The four cells whose centers are around a place: the lower one of them, and the shares of the upper ones."""

    x: int
    y: int
    right: float
    up: float


@wp.func
def corner_of(place: wp.vec2) -> Corner:
    corner = Corner()
    corner.x = int(wp.floor(place[0] - 0.5))
    corner.y = int(wp.floor(place[1] - 0.5))
    corner.right = place[0] - 0.5 - float(corner.x)
    corner.up = place[1] - 0.5 - float(corner.y)
    return corner


@wp.func
def cell_of(corner: Corner, k: int, size: int) -> int:
    """Returns the number of the corner's cell k, from 0 to 3. The map repeats after ``size`` cells."""
    x, y = (corner.x + k % 2) % size, (corner.y + k / 2) % size
    return wp.where(y < 0, y + size, y) * size + wp.where(x < 0, x + size, x)


@wp.func
def share_of(corner: Corner, k: int) -> float:
    """Returns the share of cell k in the place: bilinear interpolation."""
    return wp.where(k % 2 == 1, corner.right, 1.0 - corner.right) * wp.where(k / 2 == 1, corner.up, 1.0 - corner.up)


@wp.kernel
def visit(
    due: wp.array[bool],
    renewed: wp.array[bool],
    frames: wp.array[wp.vec3],
    places: wp.array[wp.vec2],
    seconds: float,
    size: int,
    cells: wp.array2d[float],
    times: wp.array2d[float],
    first: int,
):
    """Adds ``seconds`` where the rovers are, and writes the ``times`` at ``places`` around them.

    ``frames`` are x, y, in cells, and heading (rad) of the rovers. The map of a ``renewed`` row is cleared before.
    """
    row = first + wp.tid()
    if due[row]:
        if renewed[row]:
            for k in range(cells.shape[1]):
                cells[row, k] = 0.0
        frame = frames[row]
        center, cos, sin = wp.vec2(frame[0], frame[1]), wp.cos(frame[2]), wp.sin(frame[2])
        here = corner_of(center)
        for k in range(4):
            cells[row, cell_of(here, k, size)] += seconds * share_of(here, k)
        for place in range(places.shape[0]):
            at = places[place]
            corner = corner_of(center + wp.vec2(cos * at[0] - sin * at[1], sin * at[0] + cos * at[1]))
            time = float(0.0)
            for k in range(4):
                time += cells[row, cell_of(corner, k, size)] * share_of(corner, k)
            times[row, place] = time
