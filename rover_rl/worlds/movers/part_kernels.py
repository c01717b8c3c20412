"""Warp kernels on the parts of movers: they place them on the ground, and intersect rays with them.

A ray is intersected in the frame of the part, whose origin is the center and whose z axis is the axis of a cylinder or
capsule. Its points are ``o + t d`` with a unit vector d. A convex solid contains an interval ``[t_in, t_out]``, the
intersection of the intervals of half-spaces and quadrics. The ray meets it at ``t_in``, or at 0 if it starts inside.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from rover_rl.native.warp import launch_rows, wp
from rover_rl.worlds.ground_kernels import Grounds, grounds_of, height_at
from rover_rl.worlds.movers.motion import MoverState
from rover_rl.worlds.movers.mover import KINDS
from rover_rl.worlds.movers.parts import MAX_SPEED, Parts
from rover_rl.worlds.terrain import TerrainRows

CYLINDER, BOX, CAPSULE = range(len(KINDS))
MISS = wp.constant(1.0e9)
"""Distance of a ray that meets nothing, m."""
TWO_PI, PI = wp.constant(6.2831853), wp.constant(3.14159265358979)
FASTEST = wp.constant(MAX_SPEED)


@wp.struct
class PartArrays:
    """Parts of the movers of all rows: see :class:`~rover_rl.worlds.movers.parts.Parts`."""

    kind: wp.array2d[int]
    half: wp.array2d[wp.vec3]
    position: wp.array2d[wp.vec3]
    orientation: wp.array2d[wp.quat]
    velocity: wp.array2d[wp.vec3]
    turn: wp.array2d[float]


@wp.struct
class LocalParts:
    """Parts in the frames of their movers: see :class:`~rover_rl.worlds.movers.Part`."""

    mover: wp.array2d[wp.int64]
    center: wp.array2d[wp.vec3]
    orientation: wp.array2d[wp.quat]
    swing: wp.array2d[float]


DTYPES = {"orientation": wp.quat, **dict.fromkeys(("half", "position", "velocity", "center"), wp.vec3)}


def _filled(arrays: Any, values: Mapping[str, Tensor]) -> Any:
    """Returns a struct of kernels with its arrays, in the memory of tensors."""
    for name in type(arrays).cls.__annotations__:
        setattr(arrays, name, wp.from_torch(values[name], dtype=DTYPES.get(name)))
    return arrays


def place(
    parts: Parts,
    yaw: Tensor,
    local: Mapping[str, Tensor],
    state: MoverState,
    swing: Tensor,
    terrains: TerrainRows,
    rows: Tensor,
    begins: bool,
    dt: float,
) -> None:
    """Places the parts of the movers in ``rows`` (bool ``[N, 1]``) on the ground, in place. Others are at rest.

    ``yaw [N, P]`` (rad), which changes too, is the heading of each part's mover after the last step. ``local`` has the
    mover, center, orientation and swing of the parts in the frames of their movers, ``[N, P, ...]``. Legs are ahead by
    ``swing [N, M]``, relative to their amplitude. In episodes that begin, parts are at rest.
    """
    movers = [wp.from_torch(state.position.contiguous(), dtype=wp.vec2)]
    movers += [wp.from_torch(values.contiguous()) for values in (state.yaw, swing)]
    inputs = [_filled(LocalParts(), local), grounds_of(terrains), wp.from_torch(rows.squeeze(-1).contiguous())]
    inputs = [_filled(PartArrays(), vars(parts)), wp.from_torch(yaw), *movers, *inputs, begins, dt]
    launch_rows(place_parts, yaw.shape, inputs, yaw.device)


def nearest_mover(parts: Parts, points: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the horizontal distance from points ``[N, 2]`` to the nearest part, and the mover that it belongs to.

    Distances ``[N, 1]`` (m) are those to upright parts: 0 inside, and ``inf`` without parts. Movers: int64 ``[N, 1]``.
    """
    least, mover = points.new_empty(len(points)), parts.mover.new_empty(len(points))
    inputs = [_filled(PartArrays(), vars(parts)), wp.from_torch(parts.mover)]
    inputs += [wp.from_torch(points.contiguous(), dtype=wp.vec2), wp.from_torch(least), wp.from_torch(mover)]
    launch_rows(find_nearest, least.shape, inputs, least.device)
    return least[:, None], mover[:, None]


def cast_at_movers(parts: Parts, origins: Tensor, directions: Tensor, ranges: Tensor) -> Tensor:
    """Returns the ranges of rays in the world frame, where they meet a mover the distance to it, float32 ``[N, K]``, m.

    Rays have starts ``[N, K, 3]`` (m), directions of any length but 0, and the distances to what does not move, m.
    """
    ranges = ranges.clone()
    rays = (wp.from_torch(part.float().contiguous(), dtype=wp.vec3) for part in (origins, directions))
    inputs = [_filled(PartArrays(), vars(parts)), *rays, wp.from_torch(ranges)]
    launch_rows(cast_at_parts, ranges.shape, inputs, ranges.device)
    return ranges


def scan_movers(parts: Parts, poses: Tensor, mounts: Tensor, beams: Tensor, rows: Tensor, ranges: Tensor) -> None:
    """Shortens the ``ranges [N, beams]`` (m) of planar lidars in ``rows`` (bool ``[N]``) that meet a mover, in place.

    ``poses [N, 7]`` are those of the rovers, ``mounts [N, 4]`` the place of each lidar on its rover and its range, m.
    Beams have directions (ahead, left), equally spaced counter-clockwise from straight ahead, ``[beams, 2]``.
    """
    inputs = [_filled(PartArrays(), vars(parts)), wp.from_torch(poses.contiguous())]
    inputs += [wp.from_torch(mounts, dtype=wp.vec4), wp.from_torch(beams, dtype=wp.vec2)]
    inputs += [wp.from_torch(rows.contiguous()), wp.from_torch(ranges)]
    launch_rows(scan_parts, ranges.shape[:1], inputs, ranges.device)


@wp.kernel
def place_parts(
    placed: PartArrays,
    placed_yaws: wp.array2d[float],
    positions: wp.array2d[wp.vec2],
    yaws: wp.array2d[float],
    swings: wp.array2d[float],
    solids: LocalParts,
    grounds: Grounds,
    rows: wp.array[wp.bool],
    begins: bool,
    dt: float,
    first: int,
):
    """Turns a part by the yaw of its mover and moves it; its velocity is the way from where it was, in ``dt``."""
    t, part = wp.tid()
    row = first + t
    if placed.kind[row, part] < 0:
        return
    if not rows[row]:
        placed.velocity[row, part] = wp.vec3(0.0, 0.0, 0.0)
        placed.turn[row, part] = 0.0
        return
    mover = int(solids.mover[row, part])
    at = positions[row, mover]
    yaw = yaws[row, mover]
    turn = wp.quat(0.0, 0.0, wp.sin(yaw / 2.0), wp.cos(yaw / 2.0))
    center = solids.center[row, part] + wp.vec3(solids.swing[row, part] * swings[row, mover], 0.0, 0.0)
    ground = height_at(grounds, row, wp.float64(at[0]), wp.float64(at[1]))
    position = wp.vec3(at[0], at[1], ground) + wp.quat_rotate(turn, center)
    velocity = (position - placed.position[row, part]) / dt
    change = yaw - placed_yaws[row, part]
    change = change - 2.0 * PI * wp.round(change / (2.0 * PI))
    if begins or not wp.length(velocity) <= FASTEST:
        velocity = wp.vec3(0.0, 0.0, 0.0)
        change = 0.0
    placed.position[row, part] = position
    placed.orientation[row, part] = turn * solids.orientation[row, part]
    placed.velocity[row, part] = velocity
    placed.turn[row, part] = change / dt
    placed_yaws[row, part] = yaw


@wp.kernel
def find_nearest(
    parts: PartArrays,
    movers: wp.array2d[wp.int64],
    points: wp.array[wp.vec2],
    least: wp.array[float],
    mover: wp.array[wp.int64],
    first: int,
):
    """Finds the part nearest to a point of each row: a rectangle of a box, and a circle of everything else."""
    row = first + wp.tid()
    nearest = float(wp.inf)
    of = wp.int64(0)
    for part in range(parts.kind.shape[1]):
        if parts.kind[row, part] >= 0:
            at = parts.position[row, part]
            half = parts.half[row, part]
            offset = points[row] - wp.vec2(at[0], at[1])
            gap = wp.length(offset) - half[0]
            if parts.kind[row, part] == BOX:
                local = wp.quat_rotate_inv(parts.orientation[row, part], wp.vec3(offset[0], offset[1], 0.0))
                beside = wp.vec2(wp.max(wp.abs(local[0]) - half[0], 0.0), wp.max(wp.abs(local[1]) - half[1], 0.0))
                gap = wp.length(beside)
            if wp.max(gap, 0.0) < nearest:
                nearest = wp.max(gap, 0.0)
                of = movers[row, part]
    least[row] = nearest
    mover[row] = of


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
    side = quadric(
        direction[0] * direction[0] + direction[1] * direction[1],
        origin[0] * direction[0] + origin[1] * direction[1],
        origin[0] * origin[0] + origin[1] * origin[1] - radius * radius,
    )
    ends = slab(origin[2], direction[2], half)
    return entry(wp.max(side[0], ends[0]), wp.min(side[1], ends[1]))


@wp.func
def sphere(origin: wp.vec3, direction: wp.vec3, radius: float) -> float:
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


@wp.kernel
def cast_at_parts(
    parts: PartArrays,
    origins: wp.array2d[wp.vec3],
    directions: wp.array2d[wp.vec3],
    ranges: wp.array2d[float],
    first: int,
):
    t, ray = wp.tid()
    row = first + t
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
                turn = parts.orientation[row, part]
                origin = wp.quat_rotate_inv(turn, start - parts.position[row, part])
                ray_in_part = wp.quat_rotate_inv(turn, along)
                found = meet_solid(parts.kind[row, part], parts.half[row, part], origin, ray_in_part)
                nearest = wp.min(nearest, found)
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
    begin: int,
):
    """Tests the beams in the angle that a circle around a part fills in the scan plane: see :func:`circle_in_plane`."""
    row = begin + wp.tid()
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
            beam = wp.where(k < 0, k + count, wp.where(k >= count, k - count, k))
            # What is nearer hides the part.
            nearest = ranges[row, beam]
            if nearest > distance - radius:
                found = meet_solid(kind, half, origin, beams[beam][0] * along_x + beams[beam][1] * along_y)
                if found < wp.min(nearest, max_range):
                    ranges[row, beam] = found
