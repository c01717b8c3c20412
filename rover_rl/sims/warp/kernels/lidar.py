"""Planar lidar: a scan as the intersection of the world with one plane.

All beams of a scan lie in the x-y plane of the base frame, shifted to the lidar. Instead of casting rays, the kernel
intersects this scan plane with the triangles of the ground and the faces of the obstacles. Each intersection is a line
segment in the plane, and each beam that crosses a segment ends there at the latest. The result is exact for the
triangulated ground, and a segment is computed once for all the beams that cross it.

Two culling tests save work. The kernel skips blocks of ground and obstacles that the plane passes over or under, and
those that nearer intersections occlude in all directions.

On a GPU, several threads share the blocks and obstacles of a rover: its lanes. They shorten the same beams, in any
order. The ranges do not depend on it: the least distance remains, and a lane that knows the ranges of a while ago culls
less, but never what shortens a beam.

Frames: positions and heights are in the axes of the world frame, relative to the lidar (``ScanPlane.origin``) where
stated; segments and beam directions are 2D points (ahead, left) in the scan plane, in the axes of the base frame with
the origin at the lidar. Lengths in m, angles in turns of 2 pi.
"""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.scenes.scene import Scene, ground_at
from rover_rl.sims.warp.kernels.convex import max_separation_plane
from rover_rl.sims.warp.kernels.scan_plane import (
    ScanPlane,
    angle_in_turns,
    is_occluded,
    scan_plane,
    stretch_of,
    update_visibility,
)
from rover_rl.sims.warp.kernels.types import RobotModel, RoverArrays

BEAM_SLACK = 0.05
"""Tolerance of the angles of a segment's ends, in beam spacings; covers the error of :func:`angle_in_turns`."""
NEAR_DISTANCE = 4.0
"""Distance (m) up to which obstacles are intersected without an occlusion test."""
TIE = 0.9999997
"""Factor of the distance of a segment below which several lanes do not compare it with the range of a beam.

Lanes shorten beams in any order, and the least range must result. The comparison without a division rounds: without
this margin, the order would decide between two ranges that differ in the last bit, as in the maze where walls meet. A
single lane has a fixed order and needs no margin: in some 1e-5 of the readings in the maze, the last bit differs."""
RINGS_PER_UPDATE = 4
"""Rings of ground blocks between two updates of the farthest visible ranges."""


@wp.func
def clip_beams(beams: wp.array[wp.vec2], ranges: wp.array2d[float], row: int, plane: ScanPlane, a: wp.vec2, b: wp.vec2):
    """Shortens the beams that cross the segment from ``a`` to ``b``, points (ahead, left) in the scan plane.

    A beam of direction d meets the segment's line at the distance ``t = (a x e) / (d x e)`` with ``e = b - a`` and the
    2D cross product. It meets the segment itself if a and b are on different sides of it: ``(d x a) (d x b) <= 0``.
    Only the beams between the angles of a and b are tested.
    """
    count = beams.shape[0]
    along = b - a
    offset = a[0] * along[1] - a[1] * along[0]
    least = wp.abs(offset) * plane.tie
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
            if least < wp.abs(rate) * wp.min(ranges[row, beam], plane.range):
                side_a = direction[0] * a[1] - direction[1] * a[0]
                side_b = direction[0] * b[1] - direction[1] * b[0]
                if side_a * side_b <= 1.0e-9:
                    if plane.lanes == 1:
                        ranges[row, beam] = offset / rate
                    elif offset / rate < plane.range:
                        wp.atomic_min(ranges, row, beam, offset / rate)


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

    x and y are relative to the lidar. ``leg`` is positive for the lower triangle of a cell, negative for the upper one.
    ``height``, ``height_x`` and ``height_y`` are those of the corners above the scan plane, m.
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
        plane,
        wp.vec2(wp.dot(plane.ahead_from_xy, p), wp.dot(plane.left_from_xy, p)),
        wp.vec2(wp.dot(plane.ahead_from_xy, q), wp.dot(plane.left_from_xy, q)),
    )


@wp.func
def points_above_plane(scene: Scene, j: int, first: int, last: int, height: float, step: float) -> int:
    """Bit mask of the grid points of row ``j`` that are above the scan plane; bit k is column ``first + k``.

    The plane is at ``height`` (m) at the first column, and gains ``step`` per column.
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
            while cut & 1 == 0:
                cut = cut >> 1
                i += 1
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
def block_in_ring(column: int, line: int, ring: int, k: int) -> wp.vec2i:
    """Column and row of the k-th of the 8 ``ring`` blocks of a square ring, edge by edge; ring 0 is one block."""
    edge = k // wp.max(2 * ring, 1)
    along = k - edge * 2 * ring
    if edge == 0:
        return wp.vec2i(column - ring + along, line - ring)
    if edge == 1:
        return wp.vec2i(column + ring, line - ring + along)
    if edge == 2:
        return wp.vec2i(column + ring - along, line + ring)
    return wp.vec2i(column - ring, line + ring - along)


@wp.func
def may_shorten(
    scene: Scene, visible: wp.array2d[float], row: int, plane: ScanPlane, i: int, j: int, near: bool
) -> bool:
    """Whether the ground of block (i, j) may shorten beams: it meets the scan plane and is not occluded.

    A block outside of the terrain has no ground. A ``near`` block is not tested for occlusion.
    """
    if i < 0 or j < 0 or i >= scene.blocks.shape[1] or j >= scene.blocks.shape[0]:
        return False
    side = scene.cell * float(scene.block)
    block = scene.blocks[j, i]
    x = scene.origin[0] + (float(i) + 0.5) * side - plane.origin[0]
    y = scene.origin[1] + (float(j) + 0.5) * side - plane.origin[1]
    # Height of the scan plane at the block's middle. Within the block, the distance to the bounding planes changes by
    # slack at most.
    height = plane.origin[2] + plane.rise_x * x + plane.rise_y * y
    slack = 0.5 * side * (wp.abs(block[0] - plane.rise_x) + wp.abs(block[1] - plane.rise_y))
    if block[2] > height + slack or block[3] < height - slack:
        return False
    if near:
        return True
    off_x = wp.max(wp.abs(x) - 0.5 * side, 0.0)
    off_y = wp.max(wp.abs(y) - 0.5 * side, 0.0)
    distance = wp.sqrt(off_x * off_x + off_y * off_y)
    # Half of the block's diagonal, stretched into the scan plane.
    radius = 0.70710678 * side * stretch_of(plane)
    return not is_occluded(visible, row, plane, x, y, radius, distance)


@wp.func
def slice_ground(
    scene: Scene,
    beams: wp.array[wp.vec2],
    ranges: wp.array2d[float],
    visible: wp.array2d[float],
    row: int,
    plane: ScanPlane,
):
    """Shortens the beams that meet the ground, in every ``lanes``-th block.

    Visits the blocks of ground in square rings around the lidar, from near to far, up to the farthest visible range.
    """
    side = scene.cell * float(scene.block)
    column = int(wp.floor((plane.origin[0] - scene.origin[0]) / side))
    line = int(wp.floor((plane.origin[1] - scene.origin[1]) / side))
    farthest = update_visibility(ranges, visible, row, beams.shape[0], plane)
    ring = int(0)
    k = int(plane.lane)
    # Blocks of ring k are at least (k - 1) block sides away.
    while float(ring - 1) * side < farthest:
        # Searches for the next block before it slices that, so that the threads of a GPU slice together.
        found = wp.vec2i(-1, -1)
        while found[0] < 0 and float(ring - 1) * side < farthest:
            around = wp.max(8 * ring, 1)
            while k < around:
                block = block_in_ring(column, line, ring, k)
                k += plane.lanes
                if may_shorten(scene, visible, row, plane, block[0], block[1], ring < 2):
                    found = block
                    break
            if found[0] < 0:
                k -= around
                ring += 1
                if ring % RINGS_PER_UPDATE == 0:
                    farthest = update_visibility(ranges, visible, row, beams.shape[0], plane)
        if found[0] >= 0:
            slice_block(scene, beams, ranges, row, plane, found[1], found[0])


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
        clip_beams(beams, ranges, row, plane, one, two)


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


@wp.func
def slice_obstacles(
    scene: Scene,
    beams: wp.array[wp.vec2],
    ranges: wp.array2d[float],
    visible: wp.array2d[float],
    row: int,
    plane: ScanPlane,
) -> bool:
    """Shortens the beams that meet every ``lanes``-th obstacle; returns whether the lidar is inside one of these."""
    inside = bool(False)
    # Two passes: obstacles up to NEAR_DISTANCE, then the others, with an occlusion test against the first pass.
    for far in range(2):
        if far == 1:
            update_visibility(ranges, visible, row, beams.shape[0], plane)
        for obstacle in range(plane.lane, scene.spheres.shape[0], plane.lanes):
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
                        radius = sphere[3] * stretch_of(plane)
                        occluded = is_occluded(visible, row, plane, offset[0], offset[1], radius, distance)
                    elif square < sphere[3] * sphere[3]:
                        if max_separation_plane(scene, obstacle, plane.origin)[3] <= 0.0:
                            inside = True
                    if not occluded:
                        slice_obstacle(scene, beams, ranges, row, plane, obstacle)
    return inside


@wp.func
def scan_share(
    scenes: wp.array[Scene],
    models: wp.array[RobotModel],
    rovers: RoverArrays,
    beams: wp.array[wp.vec2],
    row: int,
    lane: int,
    lanes: int,
):
    """Shortens the beams of one rover by the share of the world that belongs to one of its lanes."""
    base = wp.vec3(rovers.base_state[row, 0], rovers.base_state[row, 1], rovers.base_state[row, 2])
    orientation = wp.quat(
        rovers.base_state[row, 3], rovers.base_state[row, 4], rovers.base_state[row, 5], rovers.base_state[row, 6]
    )
    scene = scenes[rovers.scene[row]]
    robot = rovers.robot[row]
    plane = scan_plane(base, orientation, models[robot].lidar_position, models[robot].lidar_range)
    plane.lane = lane
    plane.lanes = lanes
    plane.tie = wp.where(lanes == 1, 1.0, TIE)
    inside = slice_obstacles(scene, beams, rovers.ranges, rovers.visible, row, plane)
    slice_ground(scene, beams, rovers.ranges, rovers.visible, row, plane)
    if inside or plane.origin[2] < ground_at(scene, plane.origin[0], plane.origin[1])[3]:
        for beam in range(beams.shape[0]):
            wp.atomic_min(rovers.ranges, row, beam, 0.0)


@wp.kernel
def scan(
    scenes: wp.array[Scene],
    models: wp.array[RobotModel],
    rovers: RoverArrays,
    beams: wp.array[wp.vec2],
    first: int,
    lanes: int,
):
    """One scan per rover that scans, from the pose in ``rovers.base_state``: of obstacles, then the ground.

    Thread ``(t, lane)`` is one of the ``lanes`` threads that scan for rover ``first + t``. With several, the ranges of
    rovers that scan must be ``inf`` before the launch, and ``rovers.visible`` the maximum range: no thread may start
    while another one still resets them.

    Ranges are in m, ``inf`` without a return, and 0 for a lidar inside an obstacle or below the ground. ``beams`` holds
    the unit directions (ahead, left) of the beams, equally spaced counter-clockwise from straight ahead.
    """
    t, lane = wp.tid()
    row = first + t
    if not rovers.scanned[row]:
        return
    if lanes == 1:
        for beam in range(beams.shape[0]):
            rovers.ranges[row, beam] = wp.inf
    scan_share(scenes, models, rovers, beams, row, lane, lanes)
