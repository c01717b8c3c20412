"""Warp kernel that adds lidar scans to maps of seen obstacles."""

from __future__ import annotations

from rover_rl.envs.seen_map.cell_kernels import (
    CELL,
    CLOSED,
    MAX_TILT,
    MOST,
    OCCUPIED,
    UNSEEN,
    Clearance,
    address,
    cell_of,
    clear_window,
    mark,
    move_window,
    suspect,
    weaken,
)
from rover_rl.sims.native.warp import wp

HIT = wp.constant(4)
"""Evidence that a reading adds to the cell at its end."""
ROUGH_TILT = wp.constant(0.05)
"""Tilt of the rover above which the ground is not level, rad: 3 degrees. On level ground, starting and stopping tilt it
by 0.01 at most."""
AHEAD = wp.constant(3.0)
"""Distance from the rover at which a cell is closed, in cells: 0.45 m."""
WAY = wp.constant(0.5)
"""Distance up to which a rover is still around a place, m."""
NO_GAP = wp.constant(4.0)
"""Distance between the ends of neighboring beams up to which nothing fits between them, cells: 0.6 m."""
LOWEST = wp.constant(-4.0 / 3.0)
"""Height of the end of a beam, relative to the lidar, below which it is on the ground, cells: -0.2 m."""
REACH = wp.constant(60)
"""Number of cells along an axis up to which beams count: 9 m. All of them are in the window, if the lidar is at most
3 cells, 0.45 m, from the rover's center along each axis."""
STRETCH = wp.constant(4)
"""Number of cells between two heights that are compared, at most: 0.6 m."""
FARTHEST_HEIGHT = wp.constant(20)
"""Number of cells along an axis up to which the ends of beams tell heights: 3 m. An error of 1 degree in the tilt
changes the height there by 5 cm."""


@wp.func
def is_end(beam: wp.vec3, reading: float, max_range: float):
    """Returns whether a beam has hit something in the window.

    Args:
        beam: vector from the lidar to the end of the beam, in cells.
        reading: length of the beam, m.
        max_range: range at which a beam has hit nothing, m.
    """
    return reading < max_range and wp.max(wp.abs(beam[0]), wp.abs(beam[1])) < float(REACH)


@wp.func
def is_obstacle(beam: wp.vec3, up: wp.vec3, rough: bool):
    """Returns whether what a beam has hit is certainly an obstacle.

    On rough ground, the beam may end on a slope that the rover can climb. Some of the ground from below the lidar to
    the end of the beam is at least as steep as the straight line between them. So the end is an obstacle if that line
    is too steep: on a level rover with the lidar at 0.32 m, within 0.72 m. Farther ends are suspected ones.

    Args:
        beam: vector from the lidar to the end of the beam, in cells.
        up: vector from the ground below the lidar to the lidar, in cells.
        rough: whether the ground is rough.
    """
    rise = beam + up
    steep = rise[2] > wp.tan(MAX_TILT) * wp.length(wp.vec2(rise[0], rise[1]))
    return beam[2] > LOWEST and (steep or not rough)


@wp.func
def shows_ground(beam: wp.vec3, reading: float, max_range: float):
    """Returns whether the end of a beam, in cells from the lidar, tells the height of the ground."""
    return reading < max_range and wp.max(wp.abs(beam[0]), wp.abs(beam[1])) < float(FARTHEST_HEIGHT)


@wp.func
def raise_ground(x: float, y: float, z: float, heights: wp.array[float]):
    """Raises the height of the cell of a point to the point's. x and y are in cells, z in m."""
    here = address(int(wp.floor(x)), int(wp.floor(y)))
    heights[here] = wp.max(heights[here], z)


@wp.func
def close_steep(
    x: float,
    y: float,
    rough: bool,
    clearance: Clearance,
    evidence: wp.array[wp.uint8],
    boxes: wp.array[int],
    levels: wp.array[wp.uint8],
    doubts: wp.array[wp.int16],
    heights: wp.array[float],
):
    """Closes cells between that of a point, in cells, and others nearby, if the ground between them is too steep.

    The heights may be those of the nearest or of the farthest points of two cells that are n cells apart: at most n + 1
    cells. Ground that rises by more than ``tan(MAX_TILT)`` of that distance is steeper than ``MAX_TILT`` somewhere. The
    cell halfway, rounded to the higher one, is closed.
    """
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    here = heights[address(column, row)]
    for dy in range(-STRETCH, STRETCH + 1):
        for dx in range(-STRETCH, STRETCH + 1):
            there = heights[address(column + dx, row + dy)]
            square = dx * dx + dy * dy
            limit = wp.tan(MAX_TILT) * CELL * (wp.sqrt(float(square)) + 1.0)
            if there > UNSEEN and square <= STRETCH * STRETCH and wp.abs(there - here) > limit:
                upward = wp.where(there > here, 1, 0)
                to_x = column + wp.sign(dx) * ((wp.abs(dx) + upward) / 2)
                to_y = row + wp.sign(dy) * ((wp.abs(dy) + upward) / 2)
                if int(evidence[address(to_x, to_y)]) != CLOSED:
                    middle_x = float(to_x) + 0.5
                    middle_y = float(to_y) + 0.5
                    mark(middle_x, middle_y, CLOSED, rough, clearance, evidence, boxes, levels, doubts)


@wp.kernel
def add_scans(
    poses: wp.array2d[float],
    readings: wp.array2d[float],
    directions: wp.array[wp.vec2],
    mount: wp.vec3,
    max_range: float,
    clearance: Clearance,
    patience: int,
    added: wp.array[wp.bool],
    renewed: wp.array[wp.bool],
    roughs: wp.array[wp.bool],
    places: wp.array2d[float],
    waits: wp.array[int],
    centers: wp.array[wp.vec2i],
    evidences: wp.array2d[wp.uint8],
    boxes: wp.array2d[int],
    levels: wp.array2d[wp.uint8],
    doubts: wp.array2d[wp.int16],
    heights: wp.array2d[float],
    corners: wp.array3d[float],
    first: int,
):
    """Adds a scan to each row's map; thread ``t`` does row ``first + t``.

    Each beam takes 1 from the evidence of the cells that it passes, up to 1.5 cells before its end. Then each one that
    ends at an obstacle adds ``HIT`` to the cell at its end. Then the cells between two neighboring ones of these ends
    count as occupied, too, if nothing fits between them. Other ends on rough ground are suspected.

    Three kinds of cells are closed for good: those that are too steep by the heights around them, one uphill of a rover
    on a steep slope, and one on the route of a rover that has not got farther than ``WAY`` within ``patience`` scans,
    whether it cannot or does not dare to. On rough ground, the height of a cell is the greatest one that has been seen
    there, at the end of a beam or below the rover.

    The ground of a row is rough once its rover has tilted by ``ROUGH_TILT``. The row's map is cleared then, as what it
    holds may be gentle slopes.

    Args:
        poses: x, y (m), pitch, roll, yaw (rad) and z (m) of the rovers, ``[N, 6]``.
        readings: lidar readings, ``[N, P]``, m.
        directions: cosine and sine of the angle of each reading in the frame of the lidar, ``[P]``.
        mount: position of the lidar in the frame of the rover, whose origin is on the ground, m.
        max_range: range at which a beam has hit nothing, m.
        clearance: distances from obstacles at which levels begin.
        patience: number of scans after which a cell on the route of a rover that makes no way is closed.
        added: rows whose scan is added. The others do not change.
        renewed: rows whose map is cleared first.
        roughs: whether the ground is rough, ``[N]``; updated.
        places: x and y of the places around which the rovers are, ``[N, 2]``, m; updated.
        waits: number of scans since they came there, or since a cell has been closed, ``[N]``; updated.
        centers: cells in the middle of the windows; updated.
        evidences: evidence of an obstacle in each cell, ``[N, SIZE * SIZE]``; updated.
        boxes: where in each occupied cell the obstacle is: see :func:`distance_square`. ``[N, SIZE * SIZE]``; updated.
        levels: level of each cell, ``[N, SIZE * SIZE]``; updated.
        doubts: number of suspected cells around each one, ``[N, SIZE * SIZE]``; updated.
        heights: height of the ground in each cell, ``[N, SIZE * SIZE]``, m; updated on rough ground.
        corners: corners of the routes before, ``[N, 2, 2]``, m.
        first: row of the first thread.
    """
    i = first + wp.tid()
    if not added[i]:
        return
    evidence = evidences[i]
    box = boxes[i]
    level = levels[i]
    doubt = doubts[i]
    height = heights[i]
    center = wp.vec2i(cell_of(poses[i, 0]), cell_of(poses[i, 1]))
    cos_pitch = wp.cos(poses[i, 2])
    sin_pitch = wp.sin(poses[i, 2])
    cos_roll = wp.cos(poses[i, 3])
    sin_roll = wp.sin(poses[i, 3])
    was_rough = roughs[i] and not renewed[i]
    rough = was_rough or cos_pitch * cos_roll < wp.cos(ROUGH_TILT)
    roughs[i] = rough
    if renewed[i] or rough != was_rough:
        clear_window(rough, evidence, level, doubt, height)
    else:
        move_window(centers[i], center, rough, clearance, evidence, box, level, doubt, height)
    centers[i] = center
    cos = wp.cos(poses[i, 4])
    sin = wp.sin(poses[i, 4])
    # Position of the lidar, in cells.
    x = (poses[i, 0] + mount[0] * cos - mount[1] * sin) / CELL
    y = (poses[i, 1] + mount[0] * sin + mount[1] * cos) / CELL
    # Axes of the rover in the world's frame: the columns of Rz(yaw) Ry(pitch) Rx(roll).
    ahead = wp.vec3(cos_pitch * cos, cos_pitch * sin, -sin_pitch)
    left = wp.vec3(
        sin_roll * sin_pitch * cos - cos_roll * sin, sin_roll * sin_pitch * sin + cos_roll * cos, sin_roll * cos_pitch
    )
    up = mount[2] / CELL * wp.cross(ahead, left)
    count = directions.shape[0]
    for k in range(count):
        beam = readings[i, k] / CELL * (directions[k][0] * ahead + directions[k][1] * left)
        # Cells that the beam crosses along the axis along which it crosses more.
        crossed = wp.max(wp.abs(beam[0]), wp.abs(beam[1]))
        for n in range(int(wp.min(crossed - 1.5, float(REACH)))):
            part = float(n + 1) / crossed
            along = int(wp.floor(x + part * beam[0]))
            across = int(wp.floor(y + part * beam[1]))
            passed = int(evidence[address(along, across)])
            if passed > 0 and passed <= MOST:
                weaken(along, across, passed - 1, rough, clearance, evidence, box, level, doubt)
    # After all beams have passed, so that no beam clears what another one has hit.
    for k in range(count):
        beam = readings[i, k] / CELL * (directions[k][0] * ahead + directions[k][1] * left)
        if is_end(beam, readings[i, k], max_range) and is_obstacle(beam, up, rough):
            before = int(evidence[address(int(wp.floor(x + beam[0])), int(wp.floor(y + beam[1])))])
            if before <= MOST:
                value = wp.min(before + HIT, MOST)
                mark(x + beam[0], y + beam[1], value, rough, clearance, evidence, box, level, doubt)
    for k in range(count):
        beam = readings[i, k] / CELL * (directions[k][0] * ahead + directions[k][1] * left)
        # The last reading is a neighbor of the first one.
        other = (k + 1) % count
        next_beam = readings[i, other] / CELL * (directions[other][0] * ahead + directions[other][1] * left)
        gap_x = next_beam[0] - beam[0]
        gap_y = next_beam[1] - beam[1]
        hit = is_end(beam, readings[i, k], max_range) and is_obstacle(beam, up, rough)
        next_hit = is_end(next_beam, readings[i, other], max_range) and is_obstacle(next_beam, up, rough)
        if hit and next_hit and wp.length(wp.vec2(gap_x, gap_y)) < NO_GAP:
            steps = wp.ceil(wp.max(wp.abs(gap_x), wp.abs(gap_y)))
            for n in range(1, int(steps)):
                between_x = x + beam[0] + float(n) / steps * gap_x
                between_y = y + beam[1] + float(n) / steps * gap_y
                before = int(evidence[address(int(wp.floor(between_x)), int(wp.floor(between_y)))])
                mark(between_x, between_y, wp.max(before, OCCUPIED), rough, clearance, evidence, box, level, doubt)
    # After all obstacles, so that the order of the beams does not matter.
    for k in range(count):
        beam = readings[i, k] / CELL * (directions[k][0] * ahead + directions[k][1] * left)
        if rough and is_end(beam, readings[i, k], max_range) and not is_obstacle(beam, up, rough):
            suspect(x + beam[0], y + beam[1], clearance, evidence, doubt)
    here_x = poses[i, 0] / CELL
    here_y = poses[i, 1] / CELL
    if rough:
        z = poses[i, 5] + mount[0] * ahead[2] + mount[1] * left[2] + CELL * up[2]
        raise_ground(here_x, here_y, poses[i, 5], height)
        for k in range(count):
            beam = readings[i, k] / CELL * (directions[k][0] * ahead + directions[k][1] * left)
            if shows_ground(beam, readings[i, k], max_range):
                raise_ground(x + beam[0], y + beam[1], z + CELL * beam[2], height)
        # After all heights are known, so that the order of the beams does not matter.
        close_steep(here_x, here_y, rough, clearance, evidence, box, level, doubt, height)
        for k in range(count):
            beam = readings[i, k] / CELL * (directions[k][0] * ahead + directions[k][1] * left)
            if shows_ground(beam, readings[i, k], max_range):
                close_steep(x + beam[0], y + beam[1], rough, clearance, evidence, box, level, doubt, height)
    if cos_pitch * cos_roll < wp.cos(MAX_TILT):
        # The rover's vertical axis leans downhill.
        down_x = cos_roll * sin_pitch * cos + sin_roll * sin
        down_y = cos_roll * sin_pitch * sin - sin_roll * cos
        scale = AHEAD / wp.length(wp.vec2(down_x, down_y))
        mark(here_x - scale * down_x, here_y - scale * down_y, CLOSED, rough, clearance, evidence, box, level, doubt)
    waits[i] = waits[i] + 1
    if renewed[i] or wp.length(wp.vec2(poses[i, 0] - places[i, 0], poses[i, 1] - places[i, 1])) > WAY:
        places[i, 0] = poses[i, 0]
        places[i, 1] = poses[i, 1]
        waits[i] = 0
    if waits[i] >= patience:
        waits[i] = 0
        way_x = corners[i, 0, 0] - poses[i, 0]
        way_y = corners[i, 0, 1] - poses[i, 1]
        scale = AHEAD / wp.max(wp.length(wp.vec2(way_x, way_y)), 1.0e-6)
        mark(here_x + scale * way_x, here_y + scale * way_y, CLOSED, rough, clearance, evidence, box, level, doubt)
