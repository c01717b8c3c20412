"""The lidar: all beams of a scan lie in one plane, so that a scan is the slice of the world by that plane.

Each triangle of the ground and each face of an obstacle that the plane cuts leaves a segment of a line, which shortens
the beams that it spans. This is exact, and cheaper than casting rays: blocks of ground that the plane passes over or
under are skipped as a whole, and what many beams hit is looked at once.
"""

from __future__ import annotations

from rover_rl.sims.warp.kernels.convex import foremost_plane
from rover_rl.sims.warp.kernels.ground import ground_at
from rover_rl.sims.warp.kernels.types import Rover, Rovers, Scene
from rover_rl.sims.warp.library import wp

SLACK = 0.05
"""Beams by which the ends of a segment may lie off its direction's estimate."""
SECTORS = 32
"""Parts of a scan for which it is known how far they still see."""
SECTOR_SLACK = 0.01
NEAR = 4.0
"""Distance (m) up to which obstacles are looked at without asking whether they are hidden."""
LOOK_OUT = 4
"""Rings of blocks of ground between two looks at that."""


@wp.struct
class Slice:
    """The plane of a scan. Points of the world count from the lidar here.

    ``rise_x`` and ``rise_y`` are the plane's slopes; a point (x, y) of the plane lies ``x_to * (x, y)`` ahead of the
    lidar and ``y_to * (x, y)`` to its left.
    """

    origin: wp.vec3
    normal: wp.vec3
    ahead: wp.vec3
    left: wp.vec3
    rise_x: float
    rise_y: float
    x_to: wp.vec2
    y_to: wp.vec2
    range: float


@wp.func
def slice_of(position: wp.vec3, orientation: wp.quat, lidar: wp.vec3, most: float) -> Slice:
    """The plane that a lidar mounted at ``lidar`` sees to ``most`` metres."""
    plane = Slice()
    rotation = wp.quat_to_matrix(orientation)
    plane.origin = position + rotation * lidar
    plane.ahead = wp.vec3(rotation[0, 0], rotation[1, 0], rotation[2, 0])
    plane.left = wp.vec3(rotation[0, 1], rotation[1, 1], rotation[2, 1])
    plane.normal = wp.vec3(rotation[0, 2], rotation[1, 2], rotation[2, 2])
    up = plane.normal[2]
    # On its edge the plane has no slopes; a slice a hair off is as good.
    up = wp.where(wp.abs(up) < 1.0e-3, wp.where(up < 0.0, -1.0e-3, 1.0e-3), up)
    plane.rise_x = -plane.normal[0] / up
    plane.rise_y = -plane.normal[1] / up
    plane.x_to = wp.vec2(plane.ahead[0] + plane.ahead[2] * plane.rise_x, plane.ahead[1] + plane.ahead[2] * plane.rise_y)
    plane.y_to = wp.vec2(plane.left[0] + plane.left[2] * plane.rise_x, plane.left[1] + plane.left[2] * plane.rise_y)
    plane.range = most
    return plane


@wp.func
def turns(x: float, y: float) -> float:
    """Angle of (x, y) in turns, from -0.5 to 0.5, to 2e-6 (Abramowitz and Stegun 4.4.49)."""
    least = wp.min(wp.abs(x), wp.abs(y))
    most = wp.max(wp.max(wp.abs(x), wp.abs(y)), 1.0e-12)
    a = least / most
    s = a * a
    angle = 0.0208351
    angle = angle * s - 0.0851330
    angle = angle * s + 0.1801410
    angle = angle * s - 0.3302995
    angle = (angle * s + 0.9998660) * a
    if wp.abs(y) > wp.abs(x):
        angle = 1.57079633 - angle
    if x < 0.0:
        angle = 3.14159265 - angle
    return wp.where(y < 0.0, -angle, angle) * 0.15915494


@wp.func
def shorten(beams: wp.array[wp.vec2], ranges: wp.array2d[float], row: int, a: wp.vec2, b: wp.vec2):
    """Ends the beams that meet the segment from ``a`` to ``b`` there, unless they end before."""
    count = beams.shape[0]
    along = b - a
    offset = a[0] * along[1] - a[1] * along[0]
    one = turns(a[0], a[1]) * float(count)
    two = turns(b[0], b[1]) * float(count)
    low = wp.min(one, two)
    high = wp.max(one, two)
    # The short way round.
    if high - low > 0.5 * float(count):
        swap = low + float(count)
        low = high
        high = swap
    for k in range(int(wp.ceil(low - SLACK)), int(wp.floor(high + SLACK)) + 1):
        beam = k
        if beam < 0:
            beam += count
        elif beam >= count:
            beam -= count
        direction = beams[beam]
        # The distance is offset / rate; most are divided for nothing.
        rate = direction[0] * along[1] - direction[1] * along[0]
        if offset * rate > 0.0:
            if wp.abs(offset) < wp.abs(rate) * ranges[row, beam]:
                before = direction[0] * a[1] - direction[1] * a[0]
                after = direction[0] * b[1] - direction[1] * b[0]
                if before * after <= 1.0e-9:
                    ranges[row, beam] = offset / rate


@wp.func
def cut_triangle(
    beams: wp.array[wp.vec2],
    ranges: wp.array2d[float],
    row: int,
    plane: Slice,
    x: float,
    y: float,
    leg: float,
    here: float,
    across: float,
    along: float,
):
    """Shortens the beams that meet a triangle of the ground.

    Args:
        beams, ranges, row, plane: of the scan.
        x, y: of its right angle, from the lidar.
        leg: from there to its other corners, along x and along y.
        here, across, along: heights of the three over the plane.
    """
    up = here > 0.0
    up_across = across > 0.0
    up_along = along > 0.0
    if up == up_across and up == up_along:
        return
    # Where the triangle's plane is above the lidar, it falls away from it, behind ground that rises.
    if here * leg - (across - here) * x - (along - here) * y > 0.0 and leg > 0.0:
        return
    if here * leg - (across - here) * x - (along - here) * y < 0.0 and leg < 0.0:
        return
    # The cut goes through two of the three sides.
    p = wp.vec2(x, y)
    q = wp.vec2(x, y)
    if up == up_across:
        share = along / (along - across)
        p = wp.vec2(x + leg * share, y + leg * (1.0 - share))
    else:
        p = wp.vec2(x + leg * here / (here - across), y)
    if up == up_along:
        share = along / (along - across)
        q = wp.vec2(x + leg * share, y + leg * (1.0 - share))
    else:
        q = wp.vec2(x, y + leg * here / (here - along))
    shorten(
        beams,
        ranges,
        row,
        wp.vec2(wp.dot(plane.x_to, p), wp.dot(plane.y_to, p)),
        wp.vec2(wp.dot(plane.x_to, q), wp.dot(plane.y_to, q)),
    )


@wp.func
def above_plane(scene: Scene, j: int, first: int, last: int, rise: float, step: float) -> int:
    """Which points of a row of the grid, from ``first`` to ``last``, are above the plane: a bit each.

    Args:
        scene: has the ground.
        j, first, last: row, and columns.
        rise: height of the plane at the first of them, and
        step: what it gains from one to the next.
    """
    bits = int(0)
    for k in range(last - first + 1):
        bits |= wp.where(scene.heights[j, first + k] > rise + step * float(k), 1, 0) << k
    return bits


@wp.func
def cut_block(
    scene: Scene,
    beams: wp.array[wp.vec2],
    ranges: wp.array2d[float],
    row: int,
    plane: Slice,
    block_j: int,
    block_i: int,
):
    """Shortens the beams that meet the ground of one block."""
    cell = scene.cell
    first = block_i * scene.block
    last = wp.min(first + scene.block, scene.heights.shape[1] - 1)
    start = block_j * scene.block
    x_first = scene.corner[0] + float(first) * cell - plane.origin[0]
    y = scene.corner[1] + float(start) * cell - plane.origin[1]
    step = plane.rise_x * cell
    rise = plane.rise_x * x_first + plane.rise_y * y + plane.origin[2]
    near = above_plane(scene, start, first, last, rise, step)
    for j in range(start, wp.min(start + scene.block, scene.heights.shape[0] - 1)):
        rise_beyond = rise + plane.rise_y * cell
        far = above_plane(scene, j + 1, first, last, rise_beyond, step)
        # Cells with corners on both sides of the plane.
        some = near | (near >> 1) | far | (far >> 1)
        every = near & (near >> 1) & far & (far >> 1)
        cut = some & ~every & ((1 << (last - first)) - 1)
        i = int(first)
        while cut != 0:
            if cut & 1 == 1:
                # Heights over the plane.
                here = rise + step * float(i - first)
                beyond = rise_beyond + step * float(i - first)
                one = scene.heights[j, i] - here
                two = scene.heights[j, i + 1] - (here + step)
                three = scene.heights[j + 1, i] - beyond
                four = scene.heights[j + 1, i + 1] - (beyond + step)
                x = x_first + float(i - first) * cell
                cut_triangle(beams, ranges, row, plane, x, y, cell, one, two, three)
                cut_triangle(beams, ranges, row, plane, x + cell, y + cell, -cell, four, three, two)
            cut = cut >> 1
            i += 1
        near = far
        rise = rise_beyond
        y += cell


@wp.func
def look_out(ranges: wp.array2d[float], row: int, count: int, farthest: wp.array[float]) -> float:
    """Finds how far each sector of the scan still sees, and how far the whole scan does."""
    most = float(0.0)
    for sector in range(SECTORS):
        seen = float(0.0)
        # The beams whose directions are in the sector.
        first = (sector * count + SECTORS - 1) // SECTORS
        last = ((sector + 1) * count + SECTORS - 1) // SECTORS - 1
        # Four at once, as each would wait for the one before.
        for beam in range(first, last + 1, 4):
            one = wp.max(ranges[row, beam], ranges[row, wp.min(beam + 1, last)])
            two = wp.max(ranges[row, wp.min(beam + 2, last)], ranges[row, wp.min(beam + 3, last)])
            seen = wp.max(seen, wp.max(one, two))
        farthest[sector] = seen
        most = wp.max(most, seen)
    return most


@wp.func
def is_hidden(farthest: wp.array[float], plane: Slice, x: float, y: float, radius: float, distance: float) -> bool:
    """Whether all that is ``radius`` or less around a point of the plane, and ``distance`` or more away, is hidden."""
    ahead = plane.x_to[0] * x + plane.x_to[1] * y
    left = plane.y_to[0] * x + plane.y_to[1] * y
    middle = turns(ahead, left) * float(SECTORS)
    # The arcsine is below its argument times pi / 2.
    width = radius / wp.sqrt(ahead * ahead + left * left) * 0.25 * float(SECTORS) + SECTOR_SLACK
    for k in range(int(wp.floor(middle - width)), int(wp.floor(middle + width)) + 1):
        sector = (k + 2 * SECTORS) % SECTORS
        if farthest[sector] > distance:
            return False
    return True


@wp.func
def cut_ground(scene: Scene, beams: wp.array[wp.vec2], ranges: wp.array2d[float], row: int, plane: Slice):
    """Shortens the beams that meet the ground: block by block from near to far, less those that are hidden."""
    side = scene.cell * float(scene.block)
    stretch = 1.0 / wp.max(wp.abs(plane.normal[2]), 1.0e-3)
    column = int(wp.floor((plane.origin[0] - scene.corner[0]) / side))
    line = int(wp.floor((plane.origin[1] - scene.corner[1]) / side))
    farthest = wp.zeros(shape=(SECTORS,), dtype=float)
    most = look_out(ranges, row, beams.shape[0], farthest)
    ring = int(0)
    # The nearest that a ring of blocks can be is its number less one.
    while float(ring - 1) * side < most:
        for k in range(wp.max(8 * ring, 1)):
            edge = k // wp.max(2 * ring, 1)
            along = k - edge * 2 * ring
            i = column - ring
            j = line - ring
            if edge == 0:
                i = column - ring + along
            elif edge == 1:
                i = column + ring
                j = line - ring + along
            elif edge == 2:
                i = column + ring - along
                j = line + ring
            else:
                j = line + ring - along
            if i >= 0 and j >= 0 and i < scene.blocks.shape[1] and j < scene.blocks.shape[0]:
                block = scene.blocks[j, i]
                x = scene.corner[0] + (float(i) + 0.5) * side - plane.origin[0]
                y = scene.corner[1] + (float(j) + 0.5) * side - plane.origin[1]
                height = plane.origin[2] + plane.rise_x * x + plane.rise_y * y
                slack = 0.5 * side * (wp.abs(block[0] - plane.rise_x) + wp.abs(block[1] - plane.rise_y))
                if block[2] <= height + slack and block[3] >= height - slack:
                    off_x = wp.max(wp.abs(x) - 0.5 * side, 0.0)
                    off_y = wp.max(wp.abs(y) - 0.5 * side, 0.0)
                    distance = wp.sqrt(off_x * off_x + off_y * off_y)
                    hidden = False
                    if ring > 1:
                        hidden = is_hidden(farthest, plane, x, y, 0.70710678 * side * stretch, distance)
                    if not hidden:
                        cut_block(scene, beams, ranges, row, plane, j, i)
        ring += 1
        if ring % LOOK_OUT == 0:
            most = look_out(ranges, row, beams.shape[0], farthest)


@wp.func
def cut_polygon(scene: Scene, beams: wp.array[wp.vec2], ranges: wp.array2d[float], row: int, plane: Slice, face: int):
    """Shortens the beams that meet one face of an obstacle."""
    start = scene.polygon_starts[face]
    end = scene.polygon_starts[face + 1]
    last = scene.polygons[end - 1] - plane.origin
    last_height = wp.dot(last, plane.normal)
    found = int(0)
    one = wp.vec2(0.0, 0.0)
    two = wp.vec2(0.0, 0.0)
    for k in range(start, end):
        corner = scene.polygons[k] - plane.origin
        height = wp.dot(corner, plane.normal)
        if (height > 0.0) != (last_height > 0.0):
            point = last + (last_height / (last_height - height)) * (corner - last)
            one = two
            two = wp.vec2(wp.dot(point, plane.ahead), wp.dot(point, plane.left))
            found += 1
        last = corner
        last_height = height
    if found == 2:
        shorten(beams, ranges, row, one, two)


@wp.func
def cut_obstacle(
    scene: Scene, beams: wp.array[wp.vec2], ranges: wp.array2d[float], row: int, plane: Slice, obstacle: int
):
    """Shortens the beams that meet an obstacle: a segment for each face that looks at the lidar."""
    for face in range(scene.plane_starts[obstacle], scene.plane_starts[obstacle + 1]):
        outward = scene.planes[face]
        sphere = scene.polygon_spheres[face]
        normal = wp.vec3(outward[0], outward[1], outward[2])
        if wp.dot(normal, plane.origin) + outward[3] > 0.0:
            middle = wp.vec3(sphere[0], sphere[1], sphere[2]) - plane.origin
            if wp.abs(wp.dot(middle, plane.normal)) < sphere[3]:
                cut_polygon(scene, beams, ranges, row, plane, face)


@wp.kernel
def scan(scene: Scene, rover: Rover, rovers: Rovers, beams: wp.array[wp.vec2], first: int):
    """Scans for the rovers from ``first`` on: ``inf`` where nothing is hit, 0 for a lidar inside something.

    ``beams`` are their directions, the first straight ahead and the others counter-clockwise at equal distances.
    """
    row = first + wp.tid()
    if not rovers.active[row]:
        return
    base = wp.vec3(rovers.body[row, 0], rovers.body[row, 1], rovers.body[row, 2])
    orientation = wp.quat(rovers.body[row, 3], rovers.body[row, 4], rovers.body[row, 5], rovers.body[row, 6])
    plane = slice_of(base, orientation, rover.lidar, rover.lidar_range)
    count = beams.shape[0]
    ground = ground_at(scene, plane.origin[0], plane.origin[1])
    inside = plane.origin[2] < ground[3]
    for beam in range(count):
        rovers.ranges[row, beam] = plane.range
    # What is near hides what is far.
    farthest = wp.zeros(shape=(SECTORS,), dtype=float)
    stretch = 1.0 / wp.max(wp.abs(plane.normal[2]), 1.0e-3)
    for far in range(2):
        if far == 1:
            look_out(rovers.ranges, row, count, farthest)
        for obstacle in range(scene.spheres.shape[0]):
            sphere = scene.spheres[obstacle]
            offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - plane.origin
            reach = plane.range + sphere[3]
            square = wp.length_sq(offset)
            if square < reach * reach and wp.abs(wp.dot(offset, plane.normal)) < sphere[3]:
                near = NEAR + sphere[3]
                if (far == 1) == (square > near * near):
                    hidden = False
                    if far == 1:
                        distance = wp.sqrt(square) - sphere[3]
                        hidden = is_hidden(farthest, plane, offset[0], offset[1], sphere[3] * stretch, distance)
                    elif square < sphere[3] * sphere[3]:
                        if foremost_plane(scene, obstacle, plane.origin)[3] <= 0.0:
                            inside = True
                    if not hidden:
                        cut_obstacle(scene, beams, rovers.ranges, row, plane, obstacle)
    cut_ground(scene, beams, rovers.ranges, row, plane)
    for beam in range(count):
        if inside:
            rovers.ranges[row, beam] = 0.0
        elif rovers.ranges[row, beam] >= plane.range:
            rovers.ranges[row, beam] = wp.inf
