"""Rays through a scene: they march through the grid of the ground, and through that of the obstacles.

Along a ray ``p(t) = start + t direction``, with a direction of length 1, the height above a plane ``z = h + a x + b y``
is linear in t. The ground of a cell is two such planes, and so are the bounds of a block of cells. A ray meets the
ground where that height becomes negative within a cell. Blocks whose upper bound it passes above are skipped.

Lengths in m; u and v are x and y in cells of the ground, from its first height.
"""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.scenes.scene import Scene, ground_at

SLOWEST = wp.constant(1.0e-9)
"""Rate below which a ray does not move along an axis."""


@wp.func
def inverse_of(rate: float) -> float:
    """Time for one unit along an axis; 0 for a ray that does not move along it."""
    return wp.where(wp.abs(rate) < SLOWEST, 0.0, 1.0 / rate)


@wp.func
def exit_time(start: float, inverse: float, low: float, high: float) -> float:
    """Time at which a ray leaves an interval of an axis."""
    if inverse > 0.0:
        return (high - start) * inverse
    if inverse < 0.0:
        return (low - start) * inverse
    return wp.inf


@wp.func
def clipped(span: wp.vec2, start: float, inverse: float, size: float) -> wp.vec2:
    """Clips the first and last time of a ray to the interval [0, size] of an axis. The first is last if it misses."""
    if inverse == 0.0:
        return wp.where(start < 0.0 or start > size, wp.vec2(wp.inf, 0.0), span)
    return wp.vec2(
        wp.max(span[0], -exit_time(-start, inverse, -size, 0.0)), wp.min(span[1], exit_time(start, inverse, 0.0, size))
    )


@wp.func
def span_within(start: wp.vec2, inverse: wp.vec2, size: wp.vec2, farthest: float) -> wp.vec2:
    """First and last time of a ray in the rectangle from 0 to ``size``. The first is last if it misses."""
    span = clipped(wp.vec2(0.0, farthest), start[0], inverse[0], size[0])
    return clipped(span, start[1], inverse[1], size[1])


@wp.func
def sign_of(inverse: float) -> int:
    """Direction in which a ray moves along an axis."""
    return wp.where(inverse < 0.0, -1, 1)


@wp.func
def passes_above(scene: Scene, column: int, line: int, start: wp.vec3, direction: wp.vec3, span: wp.vec2) -> bool:
    """Whether a ray passes above the ground of a block within a span of time."""
    bound = scene.blocks[line, column]
    side = scene.cell * float(scene.block)
    x = start[0] - scene.origin[0] - (float(column) + 0.5) * side
    y = start[1] - scene.origin[1] - (float(line) + 0.5) * side
    height = start[2] - bound[3] - bound[0] * x - bound[1] * y
    rate = direction[2] - bound[0] * direction[0] - bound[1] * direction[1]
    return height + rate * span[0] > 0.0 and height + rate * span[1] > 0.0


@wp.func
def meeting(height: float, rate: float, first: float, last: float) -> float:
    """Time in [first, last] at which a ray is no longer above a plane; ``inf`` if it stays above it."""
    if last <= first or height + rate * last >= 0.0:
        return wp.inf
    if height + rate * first <= 0.0:
        return first
    return wp.clamp(-height / rate, first, last)


@wp.func
def meet_cells(
    scene: Scene, column: int, line: int, z: float, rise: float, start: wp.vec2, rate: wp.vec2, span: wp.vec2
) -> float:
    """Time at which a ray meets the ground of a block, in which it is during ``span``; ``inf`` if it does not.

    At the start, its height is ``z`` and its u and v are ``start``; their rates are ``rise`` and ``rate``.
    """
    columns = scene.heights.shape[1]
    inverse_u = inverse_of(rate[0])
    inverse_v = inverse_of(rate[1])
    first_i = column * scene.block
    first_j = line * scene.block
    last_i = wp.min(first_i + scene.block, columns - 1) - 1
    last_j = wp.min(first_j + scene.block, scene.heights.shape[0] - 1) - 1
    t = span[0]
    i = wp.clamp(int(start[0] + rate[0] * t), first_i, last_i)
    j = wp.clamp(int(start[1] + rate[1] * t), first_j, last_j)
    # Rate of u + v, which is 1 on the diagonal of a cell, less than 1 in the lower triangle and more in the upper one.
    across = rate[0] + rate[1]
    across = wp.where(wp.abs(across) < SLOWEST, SLOWEST, across)
    while i >= first_i and j >= first_j and i <= last_i and j <= last_j and t <= span[1]:
        u = start[0] - float(i)
        v = start[1] - float(j)
        leaves_u = exit_time(u, inverse_u, 0.0, 1.0)
        leaves_v = exit_time(v, inverse_v, 0.0, 1.0)
        leaves = wp.max(wp.min(wp.min(leaves_u, leaves_v), span[1]), t)
        # Heights above the planes of both triangles, and their rates.
        right = scene.heights[j, i + 1]
        left = scene.heights[j + 1, i]
        near = scene.heights[j, i]
        far = scene.heights[j + 1, i + 1]
        low = z - near - u * (right - near) - v * (left - near)
        low_rate = rise - rate[0] * (right - near) - rate[1] * (left - near)
        high = z - far - (u - 1.0) * (far - left) - (v - 1.0) * (far - right)
        high_rate = rise - rate[0] * (far - left) - rate[1] * (far - right)
        middle = wp.clamp((1.0 - u - v) / across, t, leaves)
        if across > 0.0:
            met = wp.min(meeting(low, low_rate, t, middle), meeting(high, high_rate, middle, leaves))
        else:
            met = wp.min(meeting(high, high_rate, t, middle), meeting(low, low_rate, middle, leaves))
        if met < wp.inf:
            return met
        t = leaves
        if leaves_u < leaves_v:
            i += sign_of(inverse_u)
        else:
            j += sign_of(inverse_v)
    return wp.inf


@wp.func
def meet_ground(scene: Scene, start: wp.vec3, direction: wp.vec3, farthest: float) -> float:
    """Distance along a ray to the ground: 0 for a start below it, and ``farthest`` if it is no nearer."""
    columns = scene.heights.shape[1]
    lines = scene.heights.shape[0]
    origin = wp.vec2(start[0] - scene.origin[0], start[1] - scene.origin[1]) / scene.cell
    rate = wp.vec2(direction[0], direction[1]) / scene.cell
    inverse_u = inverse_of(rate[0])
    inverse_v = inverse_of(rate[1])
    size = wp.vec2(float(columns - 1), float(lines - 1))
    span = span_within(origin, wp.vec2(inverse_u, inverse_v), size, farthest)
    if span[0] > span[1]:
        return farthest
    if span[0] == 0.0 and start[2] < ground_at(scene, start[0], start[1])[3]:
        return 0.0
    t = span[0]
    side = float(scene.block)
    column = wp.clamp(int((origin[0] + rate[0] * t) / side), 0, scene.blocks.shape[1] - 1)
    line = wp.clamp(int((origin[1] + rate[1] * t) / side), 0, scene.blocks.shape[0] - 1)
    while t < span[1] and column >= 0 and line >= 0 and column < scene.blocks.shape[1] and line < scene.blocks.shape[0]:
        leaves_u = exit_time(origin[0], inverse_u, float(column) * side, float(column + 1) * side)
        leaves_v = exit_time(origin[1], inverse_v, float(line) * side, float(line + 1) * side)
        within = wp.vec2(t, wp.max(wp.min(wp.min(leaves_u, leaves_v), span[1]), t))
        if not passes_above(scene, column, line, start, direction, within):
            met = meet_cells(scene, column, line, start[2], direction[2], origin, rate, within)
            if met < wp.inf:
                return met
        t = within[1]
        if leaves_u < leaves_v:
            column += sign_of(inverse_u)
        else:
            line += sign_of(inverse_v)
    return farthest


@wp.func
def meet_obstacle(scene: Scene, obstacle: int, start: wp.vec3, direction: wp.vec3, farthest: float) -> float:
    """Distance along a ray to an obstacle: 0 for a start inside of it, and ``farthest`` if it is no nearer.

    A ray is inside of a convex solid from when it enters the last of the half-spaces of its faces until it leaves the
    first of them.
    """
    sphere = scene.spheres[obstacle]
    offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - start
    along = wp.dot(offset, direction)
    beside = wp.length_sq(offset) - along * along
    if beside > sphere[3] * sphere[3] or along < -sphere[3] or along - sphere[3] > farthest:
        return farthest
    enters = float(0.0)
    leaves = float(farthest)
    for k in range(scene.plane_starts[obstacle], scene.plane_starts[obstacle + 1]):
        plane = scene.planes[k]
        normal = wp.vec3(plane[0], plane[1], plane[2])
        height = wp.dot(normal, start) + plane[3]
        rate = wp.dot(normal, direction)
        if rate < 0.0:
            enters = wp.max(enters, -height / rate)
        elif height > 0.0:
            return farthest
        elif rate > 0.0:
            leaves = wp.min(leaves, -height / rate)
        if enters > leaves:
            return farthest
    return enters


@wp.func
def meet_obstacles(scene: Scene, start: wp.vec3, direction: wp.vec3, farthest: float) -> float:
    """Distance along a ray to the nearest obstacle: 0 for a start inside of one, ``farthest`` if none is nearer."""
    nearest = float(farthest)
    if scene.grid_columns == 0:
        return nearest
    cell = scene.grid_cell
    x = start[0] - scene.grid_origin[0]
    y = start[1] - scene.grid_origin[1]
    inverse_x = inverse_of(direction[0])
    inverse_y = inverse_of(direction[1])
    size = cell * wp.vec2(float(scene.grid_columns), float(scene.grid_rows))
    span = span_within(wp.vec2(x, y), wp.vec2(inverse_x, inverse_y), size, farthest)
    column = wp.clamp(int((x + direction[0] * span[0]) / cell), 0, scene.grid_columns - 1)
    line = wp.clamp(int((y + direction[1] * span[0]) / cell), 0, scene.grid_rows - 1)
    t = span[0]
    end = span[1]
    last = int(-1)
    while t < end and column >= 0 and line >= 0 and column < scene.grid_columns and line < scene.grid_rows:
        number = line * scene.grid_columns + column
        for k in range(scene.grid_starts[number], scene.grid_starts[number + 1]):
            obstacle = scene.grid_obstacles[k]
            # A long obstacle is in several cells in a row.
            if obstacle != last:
                nearest = meet_obstacle(scene, obstacle, start, direction, nearest)
                last = obstacle
        leaves_x = exit_time(x, inverse_x, cell * float(column), cell * float(column + 1))
        leaves_y = exit_time(y, inverse_y, cell * float(line), cell * float(line + 1))
        t = wp.min(leaves_x, leaves_y)
        # What a ray meets in a later cell is farther away.
        end = wp.min(end, nearest)
        if leaves_x < leaves_y:
            column += sign_of(inverse_x)
        else:
            line += sign_of(inverse_y)
    return nearest


@wp.kernel
def aim_rays(
    positions: wp.array[wp.vec3],
    orientations: wp.array[wp.quat],
    mount: wp.vec3,
    directions: wp.array[wp.vec3],
    origins: wp.array2d[wp.vec3],
    rays: wp.array2d[wp.vec3],
):
    """Writes the rays of a device in the world frame, from its mount and the directions in the frame of the rover."""
    row, ray = wp.tid()
    origins[row, ray] = positions[row] + wp.quat_rotate(orientations[row], mount)
    rays[row, ray] = wp.quat_rotate(orientations[row], directions[ray])


@wp.kernel
def cast_rays(
    scenes: wp.array[Scene],
    slots: wp.array[wp.int64],
    origins: wp.array2d[wp.vec3],
    directions: wp.array2d[wp.vec3],
    farthest: float,
    ranges: wp.array2d[float],
    first: int,
):
    """Writes the distance along each ray of each row to the ground or an obstacle of the scene in the row's slot."""
    t, ray = wp.tid()
    row = first + t
    scene = scenes[int(slots[row])]
    start = origins[row, ray]
    direction = wp.normalize(directions[row, ray])
    met = meet_ground(scene, start, direction, farthest)
    met = meet_obstacles(scene, start, direction, met)
    ranges[row, ray] = wp.where(met < farthest, met, wp.inf)
