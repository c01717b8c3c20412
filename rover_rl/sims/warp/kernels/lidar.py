"""Planar lidar: a scan as the intersection of the world with one plane.

All beams of a scan lie in the x-y plane of the base frame, shifted to the lidar. Instead of casting rays, the kernel
intersects this plane with the triangles of the ground and the faces of the obstacles. Each intersection is a line
segment in the plane, computed once for all beams that cross it, which end there at the latest. The result is exact. The
kernel skips blocks of ground and obstacles that the plane misses, and those that nearer intersections occlude.

On a GPU, several threads share the blocks and obstacles of a rover: its lanes. They shorten the same beams, in any
order. The ranges do not depend on it: the least distance remains, and a lane that knows the ranges of a while ago culls
less, but never what shortens a beam.

Frames: positions and heights are in the axes of the world frame, relative to the lidar (``Scan.origin``) where stated;
segments and beam directions are 2D points (ahead, left) in the scan plane, in the axes of the base frame with the
origin at the lidar. Lengths in m, angles in turns of 2 pi.
"""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.scenes.scene import Scene, ground_at
from rover_rl.sims.warp.kernels import scan_plane
from rover_rl.sims.warp.kernels.convex import max_separation_plane
from rover_rl.sims.warp.kernels.scan_plane import Scan, angle_in_turns, is_occluded, stretch_of, update_visibility
from rover_rl.sims.warp.kernels.types import RobotModel, RoverArrays

BEAM_SLACK = 0.05
"""Tolerance of the angles of a segment's ends, in beam spacings; covers the error of :func:`angle_in_turns`."""
NEAR_DISTANCE = 4.0
"""Distance (m) up to which obstacles are intersected without an occlusion test."""
TIE = 0.9999997
"""Factor of the distance of a segment below which several lanes do not compare it with the range of a beam.

Lanes shorten beams in any order, and the least range must result. The comparison without a division rounds: the order
would decide between two ranges that differ in the last bit, as in the maze where walls meet. A single lane has a fixed
order and no margin: in some 1e-5 of the readings in the maze, the last bit differs."""
RINGS_PER_UPDATE = 4
"""Rings of ground blocks between two updates of the farthest visible ranges."""


@wp.func
def clip_beams(scan: Scan, a: wp.vec2, b: wp.vec2):
    """Shortens the beams that cross the segment from ``a`` to ``b``, points (ahead, left) in the scan scan.

    A beam of direction d meets the segment's line at the distance ``t = (a x e) / (d x e)`` with ``e = b - a`` and the
    2D cross product. It meets the segment itself if a and b are on different sides of it: ``(d x a) (d x b) <= 0``.
    Only the beams between the angles of a and b are tested.
    """
    count = scan.beams.shape[0]
    along = b - a
    offset = a[0] * along[1] - a[1] * along[0]
    least = wp.abs(offset) * scan.tie
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
        direction = scan.beams[beam]
        rate = direction[0] * along[1] - direction[1] * along[0]
        # t > 0, and t < range compared without a division, as most beams end nearer already.
        if offset * rate > 0.0:
            if least < wp.abs(rate) * wp.min(scan.ranges[scan.row, beam], scan.range):
                side_a = direction[0] * a[1] - direction[1] * a[0]
                side_b = direction[0] * b[1] - direction[1] * b[0]
                if side_a * side_b <= 1.0e-9:
                    if scan.lanes == 1:
                        scan.ranges[scan.row, beam] = offset / rate
                    elif offset / rate < scan.range:
                        wp.atomic_min(scan.ranges, scan.row, beam, offset / rate)


@wp.func
def slice_triangle(scan: Scan, x: float, y: float, leg: float, height: float, height_x: float, height_y: float):
    """Shortens the beams that meet a triangle of the ground.

    It has its right angle at (x, y), relative to the lidar, and its other corners at (x + leg, y) and (x, y + leg), at
    these heights above the scan plane. ``leg`` is negative for the upper triangle of a cell. The plane cuts the two
    sides whose ends lie on different sides of it, at the share ``h_1 / (h_1 - h_2)`` of the way from end 1 to end 2.
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
    a = wp.vec2(wp.dot(scan.ahead_from_xy, p), wp.dot(scan.left_from_xy, p))
    b = wp.vec2(wp.dot(scan.ahead_from_xy, q), wp.dot(scan.left_from_xy, q))
    clip_beams(scan, a, b)


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
def slice_block(scene: Scene, scan: Scan, block_j: int, block_i: int):
    """Shortens the beams that meet the ground of one block.

    In each row of cells, bit masks of the grid points above the plane give the cells that it cuts.
    """
    cell = scene.cell
    first = block_i * scene.block
    last = wp.min(first + scene.block, scene.heights.shape[1] - 1)
    start = block_j * scene.block
    x_first = scene.origin[0] + float(first) * cell - scan.origin[0]
    y = scene.origin[1] + float(start) * cell - scan.origin[1]
    # Height of the plane in the world frame at the first column of this row of grid points and of the next one.
    step = scan.rise_x * cell
    plane_height = scan.rise_x * x_first + scan.rise_y * y + scan.origin[2]
    bits = points_above_plane(scene, start, first, last, plane_height, step)
    for j in range(start, wp.min(start + scene.block, scene.heights.shape[0] - 1)):
        next_height = plane_height + scan.rise_y * cell
        next_bits = points_above_plane(scene, j + 1, first, last, next_height, step)
        # Bit k of a cell: some, and all, of its four corners are above the scan.
        some = bits | (bits >> 1) | next_bits | (next_bits >> 1)
        every = bits & (bits >> 1) & next_bits & (next_bits >> 1)
        cut = some & ~every & ((1 << (last - first)) - 1)
        i = int(first)
        while cut != 0:
            while cut & 1 == 0:
                cut = cut >> 1
                i += 1
            # Heights of the four corners above the scan.
            here = plane_height + step * float(i - first)
            beyond = next_height + step * float(i - first)
            h00 = scene.heights[j, i] - here
            h10 = scene.heights[j, i + 1] - (here + step)
            h01 = scene.heights[j + 1, i] - beyond
            h11 = scene.heights[j + 1, i + 1] - (beyond + step)
            x = x_first + float(i - first) * cell
            slice_triangle(scan, x, y, cell, h00, h10, h01)
            slice_triangle(scan, x + cell, y + cell, -cell, h11, h01, h10)
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
def may_shorten(scene: Scene, scan: Scan, i: int, j: int, near: bool) -> bool:
    """Whether the ground of block (i, j) may shorten beams: it meets the scan plane and is not occluded.

    A block outside of the terrain has no ground. A ``near`` block is not tested for occlusion.
    """
    if i < 0 or j < 0 or i >= scene.blocks.shape[1] or j >= scene.blocks.shape[0]:
        return False
    side = scene.cell * float(scene.block)
    block = scene.blocks[j, i]
    x = scene.origin[0] + (float(i) + 0.5) * side - scan.origin[0]
    y = scene.origin[1] + (float(j) + 0.5) * side - scan.origin[1]
    # Height of the scan plane at the block's middle. Within the block, the distance to the bounding planes changes by
    # slack at most.
    height = scan.origin[2] + scan.rise_x * x + scan.rise_y * y
    slack = 0.5 * side * (wp.abs(block[0] - scan.rise_x) + wp.abs(block[1] - scan.rise_y))
    if block[2] > height + slack or block[3] < height - slack:
        return False
    if near:
        return True
    off_x = wp.max(wp.abs(x) - 0.5 * side, 0.0)
    off_y = wp.max(wp.abs(y) - 0.5 * side, 0.0)
    distance = wp.sqrt(off_x * off_x + off_y * off_y)
    # Half of the block's diagonal, stretched into the plane.
    radius = 0.70710678 * side * stretch_of(scan)
    return not is_occluded(scan, x, y, radius, distance)


@wp.func
def slice_ground(scene: Scene, scan: Scan):
    """Shortens the beams that meet the ground, in every ``lanes``-th block: in square rings, from near to far."""
    side = scene.cell * float(scene.block)
    column = int(wp.floor((scan.origin[0] - scene.origin[0]) / side))
    line = int(wp.floor((scan.origin[1] - scene.origin[1]) / side))
    farthest = update_visibility(scan)
    ring = int(0)
    k = int(scan.lane)
    # Blocks of ring k are at least (k - 1) block sides away.
    while float(ring - 1) * side < farthest:
        # Searches for the next block before it slices that, so that the threads of a GPU slice together.
        found = wp.vec2i(-1, -1)
        while found[0] < 0 and float(ring - 1) * side < farthest:
            around = wp.max(8 * ring, 1)
            while k < around:
                block = block_in_ring(column, line, ring, k)
                k += scan.lanes
                if may_shorten(scene, scan, block[0], block[1], ring < 2):
                    found = block
                    break
            if found[0] < 0:
                k -= around
                ring += 1
                if ring % RINGS_PER_UPDATE == 0:
                    farthest = update_visibility(scan)
        if found[0] >= 0:
            slice_block(scene, scan, found[1], found[0])


@wp.func
def slice_face(scene: Scene, scan: Scan, face: int, first_vertex: int):
    """Shortens the beams that meet one face of an obstacle.

    The scan plane cuts a convex polygon in two of its edges or none: those whose ends lie on different sides of it.
    """
    start = scene.face_starts[face]
    end = scene.face_starts[face + 1]
    last = scene.vertices[first_vertex + scene.corners[end - 1]] - scan.origin
    last_height = wp.dot(last, scan.normal)
    found = int(0)
    one = wp.vec2(0.0, 0.0)
    two = wp.vec2(0.0, 0.0)
    for k in range(start, end):
        corner = scene.vertices[first_vertex + scene.corners[k]] - scan.origin
        height = wp.dot(corner, scan.normal)
        if (height > 0.0) != (last_height > 0.0):
            point = last + (last_height / (last_height - height)) * (corner - last)
            one = two
            two = wp.vec2(wp.dot(point, scan.ahead), wp.dot(point, scan.left))
            found += 1
        last = corner
        last_height = height
    if found == 2:
        clip_beams(scan, one, two)


@wp.func
def slice_obstacle(scene: Scene, scan: Scan, obstacle: int):
    """Shortens the beams that meet an obstacle: intersects the faces that look toward the lidar."""
    start = scene.plane_starts[obstacle]
    first_face = scene.first_faces[obstacle]
    first_vertex = scene.vertex_starts[obstacle]
    for k in range(start, scene.plane_starts[obstacle + 1]):
        outward = scene.planes[k]
        normal = wp.vec3(outward[0], outward[1], outward[2])
        if wp.dot(normal, scan.origin) + outward[3] > 0.0:
            slice_face(scene, scan, first_face + k - start, first_vertex)


@wp.func
def slice_obstacles(scene: Scene, scan: Scan) -> bool:
    """Shortens the beams that meet every ``lanes``-th obstacle; returns whether the lidar is inside one of these."""
    inside = bool(False)
    # Two passes: obstacles up to NEAR_DISTANCE, then the others, with an occlusion test against the first pass.
    for far in range(2):
        if far == 1:
            update_visibility(scan)
        for obstacle in range(scan.lane, scene.spheres.shape[0], scan.lanes):
            sphere = scene.spheres[obstacle]
            offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - scan.origin
            reach = scan.range + sphere[3]
            square = wp.length_sq(offset)
            # The bounding sphere is within range and meets the scan scan.
            if square < reach * reach and wp.abs(wp.dot(offset, scan.normal)) < sphere[3]:
                near = NEAR_DISTANCE + sphere[3]
                if (far == 1) == (square > near * near):
                    occluded = False
                    if far == 1:
                        distance = wp.sqrt(square) - sphere[3]
                        radius = sphere[3] * stretch_of(scan)
                        occluded = is_occluded(scan, offset[0], offset[1], radius, distance)
                    elif square < sphere[3] * sphere[3]:
                        if max_separation_plane(scene, obstacle, scan.origin)[3] <= 0.0:
                            inside = True
                    if not occluded:
                        slice_obstacle(scene, scan, obstacle)
    return inside


@wp.func
def scan_of(rovers: RoverArrays, model: RobotModel, beams: wp.array[wp.vec2], row: int, lane: int, lanes: int) -> Scan:
    """The share of the scan of a rover that belongs to one of its lanes."""
    base = wp.vec3(rovers.base_state[row, 0], rovers.base_state[row, 1], rovers.base_state[row, 2])
    orientation = wp.quat(
        rovers.base_state[row, 3], rovers.base_state[row, 4], rovers.base_state[row, 5], rovers.base_state[row, 6]
    )
    share = scan_plane.start_scan(base, orientation, model.lidar_position, model.lidar_range)
    share.beams = beams
    share.ranges = rovers.ranges
    share.visible = rovers.visible
    share.row = row
    share.lane = lane
    share.lanes = lanes
    share.tie = wp.where(lanes == 1, 1.0, TIE)
    return share


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
    scene = scenes[rovers.scene[row]]
    share = scan_of(rovers, models[rovers.robot[row]], beams, row, lane, lanes)
    inside = slice_obstacles(scene, share)
    slice_ground(scene, share)
    if inside or share.origin[2] < ground_at(scene, share.origin[0], share.origin[1])[3]:
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
    while another one still resets them. ``beams`` are unit directions (ahead, left), counter-clockwise from ahead.

    Ranges are ``inf`` without a return, and 0 for a lidar inside an obstacle or below the ground.
    """
    t, lane = wp.tid()
    row = first + t
    if not rovers.scanned[row]:
        return
    if lanes == 1:
        for beam in range(beams.shape[0]):
            rovers.ranges[row, beam] = wp.inf
    scan_share(scenes, models, rovers, beams, row, lane, lanes)
