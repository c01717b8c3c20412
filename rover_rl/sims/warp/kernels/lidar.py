"""Planar lidar: a scan as the intersection of the world with one plane.

All beams of a scan lie in the x-y plane of the base frame, shifted to the lidar. Instead of casting rays, the kernel
intersects this scan plane with the triangles of the ground and the faces of the obstacles. Each intersection is a line
segment in the plane, and each beam that crosses a segment ends there at the latest. The result is exact for the
triangulated ground, and a segment is computed once for all the beams that cross it.

Two culling tests save work. The kernel skips blocks of ground and obstacles that the plane passes over or under, and
those that nearer intersections occlude in all directions.

Frames: positions and heights are in the axes of the world frame, relative to the lidar (``ScanPlane.origin``) where
stated; segments and beam directions are 2D points (ahead, left) in the scan plane, in the axes of the base frame with
the origin at the lidar. Lengths in m, angles in turns of 2 pi.
"""

from __future__ import annotations

from rover_rl.sims.native.warp import wp
from rover_rl.sims.warp.kernels.convex import max_separation_plane
from rover_rl.sims.warp.kernels.ground import ground_at
from rover_rl.sims.warp.kernels.types import RobotModel, RoverArrays, Scene

BEAM_SLACK = 0.05
"""Tolerance of the angles of a segment's ends, in beam spacings; covers the error of :func:`angle_in_turns`."""
SECTORS = 32
"""Sectors of a scan for which the farthest visible range is tracked."""
SECTOR_SLACK = 0.01
"""Tolerance of angles in the occlusion test, in sectors."""
NEAR_DISTANCE = 4.0
"""Distance (m) up to which obstacles are intersected without an occlusion test."""
RINGS_PER_UPDATE = 4
"""Rings of ground blocks between two updates of the farthest visible ranges."""


@wp.struct
class ScanPlane:
    """The plane of a scan.

    ``origin`` is the lidar in the world frame; ``ahead``, ``left`` and ``normal`` are the axes of the base frame in the
    world frame. Relative to the lidar, the plane is ``z = rise_x x + rise_y y``; its point above (x, y) lies
    ``ahead_from_xy . (x, y)`` ahead of the lidar and ``left_from_xy . (x, y)`` to its left. ``range`` is the maximum
    range of the lidar.
    """

    origin: wp.vec3
    normal: wp.vec3
    ahead: wp.vec3
    left: wp.vec3
    rise_x: float
    rise_y: float
    ahead_from_xy: wp.vec2
    left_from_xy: wp.vec2
    range: float


@wp.func
def scan_plane(position: wp.vec3, orientation: wp.quat, lidar_position: wp.vec3, max_range: float) -> ScanPlane:
    """Scan plane of a lidar mounted at ``lidar_position`` in the base frame.

    From ``n . p = 0``: ``rise_x = -n_x / n_z``, ``rise_y = -n_y / n_z``. With the axis a = (a_x, a_y, a_z) of the base
    frame, ``a . (x, y, rise_x x + rise_y y) = (a_x + a_z rise_x) x + (a_y + a_z rise_y) y``.
    """
    plane = ScanPlane()
    rotation = wp.quat_to_matrix(orientation)
    plane.origin = position + rotation * lidar_position
    plane.ahead = wp.vec3(rotation[0, 0], rotation[1, 0], rotation[2, 0])
    plane.left = wp.vec3(rotation[0, 1], rotation[1, 1], rotation[2, 1])
    plane.normal = wp.vec3(rotation[0, 2], rotation[1, 2], rotation[2, 2])
    up = plane.normal[2]
    # A vertical plane has no slopes: use one that is tilted by a milliradian.
    up = wp.where(wp.abs(up) < 1.0e-3, wp.where(up < 0.0, -1.0e-3, 1.0e-3), up)
    plane.rise_x = -plane.normal[0] / up
    plane.rise_y = -plane.normal[1] / up
    plane.ahead_from_xy = wp.vec2(
        plane.ahead[0] + plane.ahead[2] * plane.rise_x, plane.ahead[1] + plane.ahead[2] * plane.rise_y
    )
    plane.left_from_xy = wp.vec2(
        plane.left[0] + plane.left[2] * plane.rise_x, plane.left[1] + plane.left[2] * plane.rise_y
    )
    plane.range = max_range
    return plane


@wp.func
def angle_in_turns(x: float, y: float) -> float:
    """Angle of (x, y) in turns, from -0.5 to 0.5, with an error below 2e-6.

    Polynomial approximation of arctan on [0, 1] (M. Abramowitz and I. Stegun, "Handbook of Mathematical Functions",
    4.4.49), extended to all octants by symmetry.
    """
    smaller = wp.min(wp.abs(x), wp.abs(y))
    larger = wp.max(wp.max(wp.abs(x), wp.abs(y)), 1.0e-12)
    a = smaller / larger
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
def clip_beams(beams: wp.array[wp.vec2], ranges: wp.array2d[float], row: int, a: wp.vec2, b: wp.vec2):
    """Shortens the beams that cross the segment from ``a`` to ``b``, points (ahead, left) in the scan plane.

    A beam of direction d meets the segment's line at the distance ``t = (a x e) / (d x e)`` with ``e = b - a`` and the
    2D cross product. It meets the segment itself if a and b are on different sides of it: ``(d x a) (d x b) <= 0``.
    Only the beams between the angles of a and b are tested.
    """
    count = beams.shape[0]
    along = b - a
    offset = a[0] * along[1] - a[1] * along[0]
    angle_a = angle_in_turns(a[0], a[1]) * float(count)
    angle_b = angle_in_turns(b[0], b[1]) * float(count)
    low = wp.min(angle_a, angle_b)
    high = wp.max(angle_a, angle_b)
    # A segment spans less than half a turn: if the difference is more, it crosses the direction straight behind.
    if high - low > 0.5 * float(count):
        swap = low + float(count)
        low = high
        high = swap
    for k in range(int(wp.ceil(low - BEAM_SLACK)), int(wp.floor(high + BEAM_SLACK)) + 1):
        beam = k
        if beam < 0:
            beam += count
        elif beam >= count:
            beam -= count
        direction = beams[beam]
        rate = direction[0] * along[1] - direction[1] * along[0]
        # t > 0, and t < range compared without a division, as most beams end nearer already.
        if offset * rate > 0.0:
            if wp.abs(offset) < wp.abs(rate) * ranges[row, beam]:
                side_a = direction[0] * a[1] - direction[1] * a[0]
                side_b = direction[0] * b[1] - direction[1] * b[0]
                if side_a * side_b <= 1.0e-9:
                    ranges[row, beam] = offset / rate


@wp.func
def slice_triangle(
    beams: wp.array[wp.vec2],
    ranges: wp.array2d[float],
    row: int,
    plane: ScanPlane,
    x: float,
    y: float,
    leg: float,
    height: float,
    height_x: float,
    height_y: float,
):
    """Shortens the beams that meet a triangle of the ground.

    The triangle has its right angle at (x, y) and its other corners at (x + leg, y) and (x, y + leg). The plane cuts
    the two sides whose ends lie on different sides of it, at the share ``h_1 / (h_1 - h_2)`` of the way from end 1 to
    end 2 (marching triangles).

    Args:
        beams: directions of the beams in the scan plane.
        ranges: ranges of all rovers, m.
        row: row of the rover.
        plane: scan plane.
        x: x of the right-angle corner relative to the lidar, m.
        y: y of the right-angle corner relative to the lidar, m.
        leg: signed length of the legs, m: positive for the lower triangle of a cell, negative for the upper one.
        height: height of the right-angle corner above the scan plane, m.
        height_x: height of the corner (x + leg, y) above the scan plane, m.
        height_y: height of the corner (x, y + leg) above the scan plane, m.
    """
    above = height > 0.0
    above_x = height_x > 0.0
    above_y = height_y > 0.0
    if above == above_x and above == above_y:
        return
    # Back-face culling: if the triangle's plane passes above the lidar, the lidar would see its underside. The
    # expression is that plane's height above the lidar, times leg.
    if height * leg - (height_x - height) * x - (height_y - height) * y > 0.0 and leg > 0.0:
        return
    if height * leg - (height_x - height) * x - (height_y - height) * y < 0.0 and leg < 0.0:
        return
    # p is on the leg along x, or else on the hypotenuse; q is on the leg along y, or else on the hypotenuse.
    p = wp.vec2(x, y)
    q = wp.vec2(x, y)
    if above == above_x:
        share = height_y / (height_y - height_x)
        p = wp.vec2(x + leg * share, y + leg * (1.0 - share))
    else:
        p = wp.vec2(x + leg * height / (height - height_x), y)
    if above == above_y:
        share = height_y / (height_y - height_x)
        q = wp.vec2(x + leg * share, y + leg * (1.0 - share))
    else:
        q = wp.vec2(x, y + leg * height / (height - height_y))
    clip_beams(
        beams,
        ranges,
        row,
        wp.vec2(wp.dot(plane.ahead_from_xy, p), wp.dot(plane.left_from_xy, p)),
        wp.vec2(wp.dot(plane.ahead_from_xy, q), wp.dot(plane.left_from_xy, q)),
    )


@wp.func
def points_above_plane(scene: Scene, j: int, first: int, last: int, height: float, step: float) -> int:
    """Bit mask of the grid points of a row that are above the scan plane; bit k is column ``first + k``.

    Args:
        scene: world with the ground.
        j: row of the grid.
        first: first column.
        last: last column, inclusive.
        height: height of the scan plane at the first column, m.
        step: height that the plane gains per column, m.
    """
    bits = int(0)
    for k in range(last - first + 1):
        bits |= wp.where(scene.heights[j, first + k] > height + step * float(k), 1, 0) << k
    return bits


@wp.func
def slice_block(
    scene: Scene,
    beams: wp.array[wp.vec2],
    ranges: wp.array2d[float],
    row: int,
    plane: ScanPlane,
    block_j: int,
    block_i: int,
):
    """Shortens the beams that meet the ground of one block.

    Goes through the block by rows of cells. Bit masks of the grid points above the plane give the cells that the plane
    cuts: those with corners on both sides of it.
    """
    cell = scene.cell
    first = block_i * scene.block
    last = wp.min(first + scene.block, scene.heights.shape[1] - 1)
    start = block_j * scene.block
    x_first = scene.origin[0] + float(first) * cell - plane.origin[0]
    y = scene.origin[1] + float(start) * cell - plane.origin[1]
    # Height of the plane in the world frame at the first column of this row of grid points and of the next one.
    step = plane.rise_x * cell
    plane_height = plane.rise_x * x_first + plane.rise_y * y + plane.origin[2]
    bits = points_above_plane(scene, start, first, last, plane_height, step)
    for j in range(start, wp.min(start + scene.block, scene.heights.shape[0] - 1)):
        next_height = plane_height + plane.rise_y * cell
        next_bits = points_above_plane(scene, j + 1, first, last, next_height, step)
        # Bit k of a cell: some, and all, of its four corners are above the plane.
        some = bits | (bits >> 1) | next_bits | (next_bits >> 1)
        every = bits & (bits >> 1) & next_bits & (next_bits >> 1)
        cut = some & ~every & ((1 << (last - first)) - 1)
        i = int(first)
        while cut != 0:
            if cut & 1 == 1:
                # Heights of the four corners above the plane.
                here = plane_height + step * float(i - first)
                beyond = next_height + step * float(i - first)
                h00 = scene.heights[j, i] - here
                h10 = scene.heights[j, i + 1] - (here + step)
                h01 = scene.heights[j + 1, i] - beyond
                h11 = scene.heights[j + 1, i + 1] - (beyond + step)
                x = x_first + float(i - first) * cell
                slice_triangle(beams, ranges, row, plane, x, y, cell, h00, h10, h01)
                slice_triangle(beams, ranges, row, plane, x + cell, y + cell, -cell, h11, h01, h10)
            cut = cut >> 1
            i += 1
        bits = next_bits
        plane_height = next_height
        y += cell


@wp.func
def update_visibility(ranges: wp.array2d[float], row: int, count: int, visible: wp.array[float]) -> float:
    """Writes the farthest range of each sector of the scan to ``visible`` and returns the farthest of all, m."""
    farthest = float(0.0)
    for sector in range(SECTORS):
        sector_range = float(0.0)
        # Beams whose directions are in the sector.
        first = (sector * count + SECTORS - 1) // SECTORS
        last = ((sector + 1) * count + SECTORS - 1) // SECTORS - 1
        # Groups of four shorten the chain of dependent maxima.
        for beam in range(first, last + 1, 4):
            one = wp.max(ranges[row, beam], ranges[row, wp.min(beam + 1, last)])
            two = wp.max(ranges[row, wp.min(beam + 2, last)], ranges[row, wp.min(beam + 3, last)])
            sector_range = wp.max(sector_range, wp.max(one, two))
        visible[sector] = sector_range
        farthest = wp.max(farthest, sector_range)
    return farthest


@wp.func
def is_occluded(visible: wp.array[float], plane: ScanPlane, x: float, y: float, radius: float, distance: float) -> bool:
    """Conservative occlusion test of a disk in the scan plane.

    The disk is occluded if every sector that it overlaps sees less far than to it. Its half-width in angle is
    ``asin(radius / d) <= (radius / d) (pi / 2)``, or ``0.25 radius / d`` turns.

    Args:
        visible: farthest visible range of each sector, m.
        plane: scan plane.
        x: x of the disk's center relative to the lidar, m.
        y: y of the disk's center relative to the lidar, m.
        radius: radius of the disk, m.
        distance: lower bound of the distance of its points to the lidar, m.
    """
    ahead = plane.ahead_from_xy[0] * x + plane.ahead_from_xy[1] * y
    left = plane.left_from_xy[0] * x + plane.left_from_xy[1] * y
    middle = angle_in_turns(ahead, left) * float(SECTORS)
    width = radius / wp.sqrt(ahead * ahead + left * left) * 0.25 * float(SECTORS) + SECTOR_SLACK
    for k in range(int(wp.floor(middle - width)), int(wp.floor(middle + width)) + 1):
        sector = (k + 2 * SECTORS) % SECTORS
        if visible[sector] > distance:
            return False
    return True


@wp.func
def slice_ground(scene: Scene, beams: wp.array[wp.vec2], ranges: wp.array2d[float], row: int, plane: ScanPlane):
    """Shortens the beams that meet the ground.

    Visits the blocks of ground in square rings around the lidar, from near to far, up to the farthest visible range.
    Skips blocks whose bounding planes do not meet the scan plane, and blocks that are occluded.
    """
    side = scene.cell * float(scene.block)
    # A length in the scan plane is at most this times its length seen from above.
    stretch = 1.0 / wp.max(wp.abs(plane.normal[2]), 1.0e-3)
    column = int(wp.floor((plane.origin[0] - scene.origin[0]) / side))
    line = int(wp.floor((plane.origin[1] - scene.origin[1]) / side))
    visible = wp.zeros(shape=(SECTORS,), dtype=float)
    farthest = update_visibility(ranges, row, beams.shape[0], visible)
    ring = int(0)
    # Blocks of ring k are at least (k - 1) block sides away.
    while float(ring - 1) * side < farthest:
        # The 8 k blocks of ring k, edge by edge; ring 0 is the block of the lidar.
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
                x = scene.origin[0] + (float(i) + 0.5) * side - plane.origin[0]
                y = scene.origin[1] + (float(j) + 0.5) * side - plane.origin[1]
                # Height of the scan plane at the block's middle. Within the block, the distance to the bounding planes
                # changes by slack at most.
                height = plane.origin[2] + plane.rise_x * x + plane.rise_y * y
                slack = 0.5 * side * (wp.abs(block[0] - plane.rise_x) + wp.abs(block[1] - plane.rise_y))
                if block[2] <= height + slack and block[3] >= height - slack:
                    off_x = wp.max(wp.abs(x) - 0.5 * side, 0.0)
                    off_y = wp.max(wp.abs(y) - 0.5 * side, 0.0)
                    distance = wp.sqrt(off_x * off_x + off_y * off_y)
                    occluded = False
                    if ring > 1:
                        # Half of the block's diagonal, stretched into the scan plane.
                        occluded = is_occluded(visible, plane, x, y, 0.70710678 * side * stretch, distance)
                    if not occluded:
                        slice_block(scene, beams, ranges, row, plane, j, i)
        ring += 1
        if ring % RINGS_PER_UPDATE == 0:
            farthest = update_visibility(ranges, row, beams.shape[0], visible)


@wp.func
def slice_face(
    scene: Scene,
    beams: wp.array[wp.vec2],
    ranges: wp.array2d[float],
    row: int,
    plane: ScanPlane,
    face: int,
    first_vertex: int,
):
    """Shortens the beams that meet one face of an obstacle.

    The scan plane cuts a convex polygon in two of its edges or none: those whose ends lie on different sides of it.

    Args:
        scene: world of the obstacle.
        beams: directions of the beams.
        ranges: ranges of the beams of all rovers, m.
        row: index of the rover.
        plane: scan plane.
        face: index of the face in the scene's list of faces.
        first_vertex: index of the obstacle's first vertex.
    """
    start = scene.face_starts[face]
    end = scene.face_starts[face + 1]
    last = scene.vertices[first_vertex + scene.corners[end - 1]] - plane.origin
    last_height = wp.dot(last, plane.normal)
    found = int(0)
    one = wp.vec2(0.0, 0.0)
    two = wp.vec2(0.0, 0.0)
    for k in range(start, end):
        corner = scene.vertices[first_vertex + scene.corners[k]] - plane.origin
        height = wp.dot(corner, plane.normal)
        if (height > 0.0) != (last_height > 0.0):
            point = last + (last_height / (last_height - height)) * (corner - last)
            one = two
            two = wp.vec2(wp.dot(point, plane.ahead), wp.dot(point, plane.left))
            found += 1
        last = corner
        last_height = height
    if found == 2:
        clip_beams(beams, ranges, row, one, two)


@wp.func
def slice_obstacle(
    scene: Scene, beams: wp.array[wp.vec2], ranges: wp.array2d[float], row: int, plane: ScanPlane, obstacle: int
):
    """Shortens the beams that meet an obstacle: intersects the faces that look toward the lidar."""
    start = scene.plane_starts[obstacle]
    first_face = scene.first_faces[obstacle]
    first_vertex = scene.vertex_starts[obstacle]
    for k in range(start, scene.plane_starts[obstacle + 1]):
        outward = scene.planes[k]
        normal = wp.vec3(outward[0], outward[1], outward[2])
        if wp.dot(normal, plane.origin) + outward[3] > 0.0:
            slice_face(scene, beams, ranges, row, plane, first_face + k - start, first_vertex)


@wp.kernel
def scan(scenes: wp.array[Scene], model: RobotModel, rovers: RoverArrays, beams: wp.array[wp.vec2], first: int):
    """One scan per rover that scans; thread ``t`` scans for rover ``first + t`` from the pose in ``rovers.base_state``.

    Ranges are in m, ``inf`` without a return, and 0 for a lidar inside an obstacle or below the ground. ``beams`` holds
    the unit directions (ahead, left) of the beams, equally spaced counter-clockwise from straight ahead.

    Order: near obstacles, far obstacles that these do not occlude, then the ground.
    """
    row = first + wp.tid()
    if not rovers.scanned[row]:
        return
    scene = scenes[rovers.scene[row]]
    base = wp.vec3(rovers.base_state[row, 0], rovers.base_state[row, 1], rovers.base_state[row, 2])
    orientation = wp.quat(
        rovers.base_state[row, 3], rovers.base_state[row, 4], rovers.base_state[row, 5], rovers.base_state[row, 6]
    )
    plane = scan_plane(base, orientation, model.lidar_position, model.lidar_range)
    count = beams.shape[0]
    ground = ground_at(scene, plane.origin[0], plane.origin[1])
    inside = plane.origin[2] < ground[3]
    for beam in range(count):
        rovers.ranges[row, beam] = plane.range
    visible = wp.zeros(shape=(SECTORS,), dtype=float)
    stretch = 1.0 / wp.max(wp.abs(plane.normal[2]), 1.0e-3)
    # Two passes: obstacles up to NEAR_DISTANCE, then the others, with an occlusion test against the first pass.
    for far in range(2):
        if far == 1:
            update_visibility(rovers.ranges, row, count, visible)
        for obstacle in range(scene.spheres.shape[0]):
            sphere = scene.spheres[obstacle]
            offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - plane.origin
            reach = plane.range + sphere[3]
            square = wp.length_sq(offset)
            # The bounding sphere is within range and meets the scan plane.
            if square < reach * reach and wp.abs(wp.dot(offset, plane.normal)) < sphere[3]:
                near = NEAR_DISTANCE + sphere[3]
                if (far == 1) == (square > near * near):
                    occluded = False
                    if far == 1:
                        distance = wp.sqrt(square) - sphere[3]
                        occluded = is_occluded(visible, plane, offset[0], offset[1], sphere[3] * stretch, distance)
                    elif square < sphere[3] * sphere[3]:
                        if max_separation_plane(scene, obstacle, plane.origin)[3] <= 0.0:
                            inside = True
                    if not occluded:
                        slice_obstacle(scene, beams, rovers.ranges, row, plane, obstacle)
    slice_ground(scene, beams, rovers.ranges, row, plane)
    for beam in range(count):
        if inside:
            rovers.ranges[row, beam] = 0.0
        elif rovers.ranges[row, beam] >= plane.range:
            rovers.ranges[row, beam] = wp.inf
