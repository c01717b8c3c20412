"""Warp kernels that intersect rays with the parts of movers.

A ray is intersected in the frame of the part, whose origin is the center and whose z axis is the axis of a cylinder or
capsule. Its points are ``o + t d`` with a unit vector d. A convex solid contains an interval ``[t_in, t_out]``, the
intersection of the intervals of half-spaces and quadrics. The ray meets it at ``t_in``, or at 0 if it starts inside.
"""

from __future__ import annotations

from rover_rl.native.warp import wp

CYLINDER, BOX, CAPSULE = 0, 1, 2
"""Indices in :data:`~rover_rl.worlds.movers.shapes.KINDS`."""
MISS = wp.constant(1.0e9)
"""Distance of a ray that meets nothing, m."""
TWO_PI = wp.constant(6.2831853)


@wp.struct
class PartArrays:
    """Parts of the movers of all rows: see :class:`~rover_rl.sims.movers.parts.Parts`."""

    kind: wp.array2d[int]
    half: wp.array2d[wp.vec3]
    position: wp.array2d[wp.vec3]
    orientation: wp.array2d[wp.quat]


@wp.func
def slab(origin: float, direction: float, half: float) -> wp.vec2:
    """Interval of a ray between two planes at ``+-half``."""
    if wp.abs(direction) < 1.0e-9:
        return wp.where(wp.abs(origin) <= half, wp.vec2(-MISS, MISS), wp.vec2(MISS, -MISS))
    one = (-half - origin) / direction
    two = (half - origin) / direction
    return wp.vec2(wp.min(one, two), wp.max(one, two))


@wp.func
def quadric(square: float, product: float, rest: float) -> wp.vec2:
    """Interval in which ``square t^2 + 2 product t + rest <= 0``, for ``square >= 0``."""
    if square < 1.0e-12:
        return wp.where(rest <= 0.0, wp.vec2(-MISS, MISS), wp.vec2(MISS, -MISS))
    under = product * product - square * rest
    if under < 0.0:
        return wp.vec2(MISS, -MISS)
    root = wp.sqrt(under)
    return wp.vec2((-product - root) / square, (-product + root) / square)


@wp.func
def entry(low: float, high: float) -> float:
    """Distance at which a ray enters an interval, 0 inside, ``MISS`` if the interval is empty or behind."""
    if low > high or high < 0.0:
        return MISS
    return wp.max(low, 0.0)


@wp.func
def upright_cylinder(origin: wp.vec3, direction: wp.vec3, radius: float, half: float) -> float:
    """Distance to a cylinder about z."""
    side = quadric(
        direction[0] * direction[0] + direction[1] * direction[1],
        origin[0] * direction[0] + origin[1] * direction[1],
        origin[0] * origin[0] + origin[1] * origin[1] - radius * radius,
    )
    ends = slab(origin[2], direction[2], half)
    return entry(wp.max(side[0], ends[0]), wp.min(side[1], ends[1]))


@wp.func
def sphere(origin: wp.vec3, direction: wp.vec3, radius: float) -> float:
    """Distance to a sphere."""
    ball = quadric(1.0, wp.dot(origin, direction), wp.length_sq(origin) - radius * radius)
    return entry(ball[0], ball[1])


@wp.func
def meet_solid(kind: int, half: wp.vec3, origin: wp.vec3, direction: wp.vec3) -> float:
    """Distance along a ray (m), a unit vector, to a part, both in its frame; ``MISS`` if it does not meet it."""
    if kind == CYLINDER:
        return upright_cylinder(origin, direction, half[0], half[2])
    if kind == BOX:
        x = slab(origin[0], direction[0], half[0])
        y = slab(origin[1], direction[1], half[1])
        z = slab(origin[2], direction[2], half[2])
        return entry(wp.max(x[0], wp.max(y[0], z[0])), wp.min(x[1], wp.min(y[1], z[1])))
    # A capsule is the union of a cylinder and two balls.
    middle = half[2] - half[0]
    offset = wp.vec3(0.0, 0.0, middle)
    balls = wp.min(sphere(origin - offset, direction, half[0]), sphere(origin + offset, direction, half[0]))
    return wp.min(upright_cylinder(origin, direction, half[0], middle), balls)


@wp.func
def meet_part(parts: PartArrays, row: int, part: int, start: wp.vec3, ray: wp.vec3) -> float:
    """Distance along a ray (m), a unit vector in the world frame, to a part; ``MISS`` if it does not meet it."""
    turn = parts.orientation[row, part]
    origin = wp.quat_rotate_inv(turn, start - parts.position[row, part])
    return meet_solid(parts.kind[row, part], parts.half[row, part], origin, wp.quat_rotate_inv(turn, ray))


@wp.kernel
def cast_at_parts(
    parts: PartArrays, origins: wp.array2d[wp.vec3], directions: wp.array2d[wp.vec3], ranges: wp.array2d[float]
):
    """Shortens the rays of each row that meet a part; thread ``(row, ray)``."""
    row, ray = wp.tid()
    start = origins[row, ray]
    along = wp.normalize(directions[row, ray])
    nearest = ranges[row, ray]
    for part in range(parts.kind.shape[1]):
        if parts.kind[row, part] >= 0:
            reach = wp.length(parts.half[row, part])
            offset = parts.position[row, part] - start
            ahead = wp.dot(offset, along)
            # The bounding sphere is behind, farther than what the ray meets, or beside it.
            if ahead > -reach and ahead - reach < nearest and wp.length_sq(offset) - ahead * ahead < reach * reach:
                nearest = wp.min(nearest, meet_part(parts, row, part, start, along))
    ranges[row, ray] = nearest


@wp.func
def circle_in_plane(kind: int, half: wp.vec3, center: wp.vec3, axis: wp.vec3) -> wp.vec3:
    """Circle ``(x, y, radius)`` around what the plane z = 0 cuts of a part; the radius is 0 if it cuts nothing.

    A part lies in the cylinder about its ``axis``, a unit vector through its ``center``, whose radius r is that of its
    base. The plane cuts the axis at the point ``p = c - c_z / a_z a``, and the cylinder in an ellipse about p whose
    larger half axis is ``r / |a_z|``. Where the axis is flat, the part's bounding sphere serves, of radius R: the plane
    cuts it in a circle of radius ``sqrt(R^2 - c_z^2)`` about the center.
    """
    square = wp.length_sq(half) - center[2] * center[2]
    if square <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    if wp.abs(axis[2]) < 0.5:
        return wp.vec3(center[0], center[1], wp.sqrt(square))
    along = center[2] / axis[2]
    base = half[0]
    if kind == BOX:
        base = wp.sqrt(half[0] * half[0] + half[1] * half[1])
    return wp.vec3(center[0] - along * axis[0], center[1] - along * axis[1], base / wp.abs(axis[2]))


@wp.kernel
def scan_parts(
    parts: PartArrays,
    poses: wp.array2d[float],
    mounts: wp.array[wp.vec4],
    beams: wp.array[wp.vec2],
    rows: wp.array[wp.bool],
    ranges: wp.array2d[float],
):
    """Shortens the beams of a planar lidar that meet a part; thread ``row`` of those in ``rows``.

    ``poses`` are those of the rovers, position (m) and quaternion, ``mounts`` the position of the lidar on each one
    and its range (m), and ``beams`` the directions (ahead, left), equally spaced counter-clockwise from straight ahead.
    Tests the beams in the angle that a circle around a part fills in the scan plane: see :func:`circle_in_plane`.
    """
    row = wp.tid()
    if not rows[row]:
        return
    turn = wp.quat(poses[row, 3], poses[row, 4], poses[row, 5], poses[row, 6])
    mount = wp.vec3(mounts[row][0], mounts[row][1], mounts[row][2])
    max_range = mounts[row][3]
    start = wp.vec3(poses[row, 0], poses[row, 1], poses[row, 2]) + wp.quat_rotate(turn, mount)
    # Axes of the rover in the world frame.
    ahead = wp.quat_rotate(turn, wp.vec3(1.0, 0.0, 0.0))
    left = wp.quat_rotate(turn, wp.vec3(0.0, 1.0, 0.0))
    up = wp.quat_rotate(turn, wp.vec3(0.0, 0.0, 1.0))
    count = beams.shape[0]
    for part in range(parts.kind.shape[1]):
        if parts.kind[row, part] < 0:
            continue
        kind = parts.kind[row, part]
        half = parts.half[row, part]
        orientation = parts.orientation[row, part]
        offset = parts.position[row, part] - start
        axis = wp.quat_rotate(orientation, wp.vec3(0.0, 0.0, 1.0))
        center = wp.vec3(wp.dot(ahead, offset), wp.dot(left, offset), wp.dot(up, offset))
        circle = circle_in_plane(kind, half, center, wp.vec3(wp.dot(ahead, axis), wp.dot(left, axis), wp.dot(up, axis)))
        radius = circle[2]
        distance = wp.sqrt(circle[0] * circle[0] + circle[1] * circle[1])
        if radius <= 0.0 or distance - radius >= max_range:
            continue
        first = 0
        last = count - 1
        if distance > radius:
            bearing = wp.atan2(circle[1], circle[0])
            width = wp.asin(radius / distance)
            first = int(wp.floor((bearing - width) / TWO_PI * float(count)))
            last = int(wp.ceil((bearing + width) / TWO_PI * float(count)))
        # In the frame of the part, beams are combinations of two directions.
        origin = -wp.quat_rotate_inv(orientation, offset)
        along_x = wp.quat_rotate_inv(orientation, ahead)
        along_y = wp.quat_rotate_inv(orientation, left)
        for k in range(first, last + 1):
            beam = k
            if k < 0:
                beam = k + count
            elif k >= count:
                beam = k - count
            # What is nearer hides the part.
            nearest = ranges[row, beam]
            if nearest > distance - radius:
                found = meet_solid(kind, half, origin, beams[beam][0] * along_x + beams[beam][1] * along_y)
                if found < wp.min(nearest, max_range):
                    ranges[row, beam] = found
