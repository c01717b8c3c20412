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
        distance = offset / (direction[0] * along[1] - direction[1] * along[0])
        if distance > 0.0 and distance < ranges[row, beam]:
            before = direction[0] * a[1] - direction[1] * a[0]
            after = direction[0] * b[1] - direction[1] * b[0]
            if before * after <= 1.0e-9:
                ranges[row, beam] = distance


@wp.func
def cut_triangle(
    beams: wp.array[wp.vec2],
    ranges: wp.array2d[float],
    row: int,
    plane: Slice,
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
):
    """Shortens the beams that meet a triangle of the ground: corners are (ahead, left, height over the plane)."""
    up_a = a[2] > 0.0
    up_b = b[2] > 0.0
    up_c = c[2] > 0.0
    if up_a == up_b and up_b == up_c:
        return
    # The corner that is on its side alone comes first.
    tip = a
    one = b
    two = c
    if up_a == up_c:
        tip = b
        one = c
        two = a
    elif up_a == up_b:
        tip = c
        one = a
        two = b
    p = tip + (tip[2] / (tip[2] - one[2])) * (one - tip)
    q = tip + (tip[2] / (tip[2] - two[2])) * (two - tip)
    # Ground that falls away from the lidar is behind ground that rises.
    here = (q[1] - p[1]) * p[0] - (q[0] - p[0]) * p[1]
    there = (q[0] - p[0]) * (tip[1] - p[1]) - (q[1] - p[1]) * (tip[0] - p[0])
    if here * there * wp.sign(tip[2]) <= 0.0:
        shorten(beams, ranges, row, wp.vec2(p[0], p[1]), wp.vec2(q[0], q[1]))


@wp.func
def corner_of(plane: Slice, x: float, y: float, height: float) -> wp.vec3:
    """(ahead, left, height over the plane) of a point of the ground; ``x`` and ``y`` count from the lidar."""
    return wp.vec3(
        plane.x_to[0] * x + plane.x_to[1] * y,
        plane.y_to[0] * x + plane.y_to[1] * y,
        height - plane.rise_x * x - plane.rise_y * y,
    )


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
    x_first = scene.corner[0] + float(first) * cell - plane.origin[0]
    for j in range(block_j * scene.block, wp.min((block_j + 1) * scene.block, scene.heights.shape[0] - 1)):
        y = scene.corner[1] + float(j) * cell - plane.origin[1]
        # Heights over the plane, so that a cell is judged by its four corners.
        rise = plane.rise_x * x_first + plane.rise_y * y + plane.origin[2]
        rise_above = rise + plane.rise_y * cell
        near = scene.heights[j, first] - rise
        far = scene.heights[j + 1, first] - rise_above
        for i in range(first, last):
            rise += plane.rise_x * cell
            rise_above += plane.rise_x * cell
            next_near = scene.heights[j, i + 1] - rise
            next_far = scene.heights[j + 1, i + 1] - rise_above
            least = wp.min(wp.min(near, far), wp.min(next_near, next_far))
            most = wp.max(wp.max(near, far), wp.max(next_near, next_far))
            if least <= 0.0 and most > 0.0:
                x = x_first + float(i - first) * cell
                right = corner_of(plane, x + cell, y, 0.0)
                above = corner_of(plane, x, y + cell, 0.0)
                right = wp.vec3(right[0], right[1], next_near)
                above = wp.vec3(above[0], above[1], far)
                here = corner_of(plane, x, y, 0.0)
                there = corner_of(plane, x + cell, y + cell, 0.0)
                cut_triangle(beams, ranges, row, plane, wp.vec3(here[0], here[1], near), right, above)
                cut_triangle(beams, ranges, row, plane, wp.vec3(there[0], there[1], next_far), above, right)
            near = next_near
            far = next_far


@wp.func
def cut_ground(scene: Scene, beams: wp.array[wp.vec2], ranges: wp.array2d[float], row: int, plane: Slice):
    """Shortens the beams that meet the ground."""
    side = scene.cell * float(scene.block)
    left = int(wp.floor((plane.origin[0] - plane.range - scene.corner[0]) / side))
    right = int(wp.floor((plane.origin[0] + plane.range - scene.corner[0]) / side))
    bottom = int(wp.floor((plane.origin[1] - plane.range - scene.corner[1]) / side))
    top = int(wp.floor((plane.origin[1] + plane.range - scene.corner[1]) / side))
    slack = 0.5 * side * (wp.abs(plane.rise_x) + wp.abs(plane.rise_y))
    for j in range(wp.max(bottom, 0), wp.min(top, scene.blocks.shape[0] - 1) + 1):
        for i in range(wp.max(left, 0), wp.min(right, scene.blocks.shape[1] - 1) + 1):
            bounds = scene.blocks[j, i]
            x = scene.corner[0] + (float(i) + 0.5) * side - plane.origin[0]
            y = scene.corner[1] + (float(j) + 0.5) * side - plane.origin[1]
            height = plane.origin[2] + plane.rise_x * x + plane.rise_y * y
            if bounds[1] >= height - slack and bounds[0] <= height + slack:
                off_x = wp.max(wp.abs(x) - 0.5 * side, 0.0)
                off_y = wp.max(wp.abs(y) - 0.5 * side, 0.0)
                if off_x * off_x + off_y * off_y < plane.range * plane.range:
                    cut_block(scene, beams, ranges, row, plane, j, i)


@wp.func
def cut_obstacle(
    scene: Scene, beams: wp.array[wp.vec2], ranges: wp.array2d[float], row: int, plane: Slice, obstacle: int
):
    """Shortens the beams that meet an obstacle: a segment for each face that looks at the lidar."""
    for face in range(scene.plane_starts[obstacle], scene.plane_starts[obstacle + 1]):
        outward = scene.planes[face]
        if (
            outward[0] * plane.origin[0] + outward[1] * plane.origin[1] + outward[2] * plane.origin[2] + outward[3]
            > 0.0
        ):
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
    cut_ground(scene, beams, rovers.ranges, row, plane)
    for obstacle in range(scene.spheres.shape[0]):
        sphere = scene.spheres[obstacle]
        offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - plane.origin
        reach = plane.range + sphere[3]
        if wp.length_sq(offset) < reach * reach and wp.abs(wp.dot(offset, plane.normal)) < sphere[3]:
            if foremost_plane(scene, obstacle, plane.origin)[3] <= 0.0:
                inside = True
            cut_obstacle(scene, beams, rovers.ranges, row, plane, obstacle)
    for beam in range(count):
        if inside:
            rovers.ranges[row, beam] = 0.0
        elif rovers.ranges[row, beam] >= plane.range:
            rovers.ranges[row, beam] = wp.inf
