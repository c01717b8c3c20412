"""Warp kernels over the cells of the free space: slopes, and headings of the rover, its lidar and its footprint.

Heading k of 64 is the yaw ``2 pi k / 64 - pi``. Orientation k of 32 stands for the headings k and k + 32, which are
equal for a symmetric footprint.
"""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.worlds.ground_kernels import Grounds, plane_at

RINGS = wp.constant(4)
"""Number of rings of test points around a cell."""
ALL = wp.constant(wp.uint32(0xFFFFFFFF))


@wp.kernel
def measure_slopes(
    ground: Grounds,
    xs: wp.array[wp.float64],
    ys: wp.array[wp.float64],
    around: wp.array[wp.vec2d],
    slopes: wp.array2d[wp.float64],
):
    """Square of the steepest slope at the points ``around`` the centers of cells; thread ``j`` does row j."""
    j = wp.tid()
    for i in range(xs.shape[0]):
        steepest = wp.float64(0.0)
        for n in range(around.shape[0]):
            plane = plane_at(ground, 0, xs[i] + around[n][0], ys[j] + around[n][1])
            steepest = wp.max(steepest, plane[1] * plane[1] + plane[2] * plane[2])
        slopes[j, i] = steepest


@wp.struct
class Stance:
    """Dimensions of a rover and the limits for its rest on the ground, m."""

    # x and y of the wheels relative to their mean, the mean, and the sums of squares along both axes.
    wheels: wp.array[wp.vec2d]
    middle: wp.vec2d
    spread: wp.vec2d
    lidar: wp.vec3d
    # Least z of the rover's up axis.
    upright: wp.float64
    # Radius of the outermost ring of test points, and least height of the scan plane above the ground there.
    reach: wp.float64
    gap: wp.float64


@wp.func
def fit_plane(ground: Grounds, stance: Stance, at: wp.vec2d, ahead: wp.vec2d) -> wp.vec3d:
    """Height (m) and slopes, forward and to the left, of the plane fitted below the wheels."""
    total = wp.float64(0.0)
    forward = wp.float64(0.0)
    left = wp.float64(0.0)
    count = stance.wheels.shape[0]
    for n in range(count):
        arm = stance.wheels[n]
        x = arm[0] + stance.middle[0]
        y = arm[1] + stance.middle[1]
        height = plane_at(ground, 0, at[0] + x * ahead[0] - y * ahead[1], at[1] + x * ahead[1] + y * ahead[0])[0]
        total += height
        forward += height * arm[0]
        left += height * arm[1]
    forward = forward / stance.spread[0]
    left = left / stance.spread[1]
    mean = total / wp.float64(count)
    return wp.vec3d(mean - forward * stance.middle[0] - left * stance.middle[1], forward, left)


@wp.kernel
def find_rest_headings(
    ground: Grounds,
    stance: Stance,
    cells: wp.array[wp.vec2d],
    ring: wp.array[wp.vec2d],
    yaws: wp.array[wp.vec2d],
    surface: wp.array2d[wp.float64],
    offsets: wp.array2d[wp.vec2d],
    headings: wp.array[wp.uint64],
):
    """Finds the headings in which a rover rests upright and scans above the ground; thread ``t`` does cell ``t``.

    At heading k, the rover lies on the plane ``z(p) = h + g p`` that is fitted below its wheels, where p is the
    position relative to the cell's center. Its up axis is ``(-g, 1) / n`` with ``n = sqrt(1 + g^2)``, and the scan
    plane is ``n lidar_z`` above the plane. Bit k of ``headings`` is set if the up axis is upright enough, and the scan
    plane is above the ground at all test points, which lie on four rings around the center. ``offsets`` are the
    positions of the lidar relative to the center, ``surface`` is memory for the heights of ``[rings * points]``.
    """
    t = wp.tid()
    at = cells[t]
    points = ring.shape[0]
    # The mean slope of the surroundings makes the bound of the highest ground of a ring tight.
    mean = wp.vec2d()
    squares = wp.float64(0.0)
    for r in range(RINGS):
        radius = stance.reach / wp.float64(4.0) * wp.float64(r + 1)
        for n in range(points):
            p = radius * ring[n]
            height = plane_at(ground, 0, at[0] + p[0], at[1] + p[1])[0]
            surface[t, r * points + n] = height
            mean = mean + height * p
        squares += radius * radius * wp.float64(points) / wp.float64(2.0)
    mean = mean / squares
    highest = wp.vec4d()
    for r in range(RINGS):
        radius = stance.reach / wp.float64(4.0) * wp.float64(r + 1)
        top = wp.float64(-wp.inf)
        for n in range(points):
            top = wp.max(top, surface[t, r * points + n] - wp.dot(mean, radius * ring[n]))
        highest[r] = top

    good = wp.uint64(0)
    for k in range(yaws.shape[0]):
        ahead = yaws[k]
        plane = fit_plane(ground, stance, at, ahead)
        slope = wp.vec2d(plane[1] * ahead[0] - plane[2] * ahead[1], plane[1] * ahead[1] + plane[2] * ahead[0])
        stretch = wp.sqrt(wp.float64(1.0) + wp.dot(slope, slope))
        up = wp.vec3d(-slope[0] / stretch, -slope[1] / stretch, wp.float64(1.0) / stretch)
        forward = wp.vec3d(ahead[0], ahead[1], plane[1])
        forward = wp.normalize(forward - wp.dot(forward, up) * up)
        side = wp.cross(up, forward)
        lidar = stance.lidar[0] * forward + stance.lidar[1] * side + stance.lidar[2] * up
        offsets[t, k] = wp.vec2d(lidar[0], lidar[1])
        if up[2] >= stance.upright:
            scan = plane[0] + stance.lidar[2] * stretch - stance.gap
            steeper = wp.length(slope - mean)
            free = bool(True)
            for r in range(RINGS):
                radius = stance.reach / wp.float64(4.0) * wp.float64(r + 1)
                # In no direction is the scan plane lower than this, relative to the mean slope.
                if free and scan - steeper * radius <= highest[r]:
                    for m in range(points):
                        if scan + wp.dot(slope, radius * ring[m]) <= surface[t, r * points + m]:
                            free = False
            if free:
                good = good | (wp.uint64(1) << wp.uint64(k))
    headings[t] = good


@wp.func
def interpolate(
    values: wp.array2d[wp.float64], origin: wp.vec2d, cell: wp.float64, x: wp.float64, y: wp.float64
) -> wp.float64:
    """Interpolates a field at the points of a grid bilinearly. Beyond the grid, its edge counts."""
    rows = values.shape[0]
    columns = values.shape[1]
    u = wp.clamp((x - origin[0]) / cell, wp.float64(0.0), wp.float64(columns - 1))
    v = wp.clamp((y - origin[1]) / cell, wp.float64(0.0), wp.float64(rows - 1))
    i = wp.min(int(u), columns - 2)
    j = wp.min(int(v), rows - 2)
    u = u - wp.float64(i)
    v = v - wp.float64(j)
    one = wp.float64(1.0)
    lower = (one - u) * values[j, i] + u * values[j, i + 1]
    upper = (one - u) * values[j + 1, i] + u * values[j + 1, i + 1]
    return (one - v) * lower + v * upper


@wp.kernel
def find_headings(
    cells: wp.array[wp.vec2d],
    offsets: wp.array2d[wp.vec2d],
    rests: wp.array[wp.uint64],
    clearance: wp.array2d[wp.float64],
    origin: wp.vec2d,
    cell: wp.float64,
    least: wp.float64,
    headings: wp.array[wp.int64],
):
    """Finds the heading bins in which the lidar is far enough from all obstacles; thread ``t`` does cell ``t``.

    Bit k of ``headings`` is set if that holds at both ends of bin k, the headings k and k + 1 of 64. ``offsets`` of the
    lidar and the headings in which a rover ``rests`` are of each cell, or the same for all.
    """
    t = wp.tid()
    own = wp.min(t, rests.shape[0] - 1)
    good = wp.uint64(0)
    for k in range(64):
        point = cells[t] + offsets[own, k]
        if interpolate(clearance, origin, cell, point[0], point[1]) >= least:
            good = good | (wp.uint64(1) << wp.uint64(k))
    good = good & rests[own]
    headings[t] = wp.int64(good & ((good >> wp.uint64(1)) | (good << wp.uint64(63))))


@wp.kernel
def fit_footprint(
    clearance: wp.array2d[wp.float64],
    cell: wp.float64,
    turning: wp.float64,
    discs: wp.array[wp.float64],
    radii: wp.array[wp.float64],
    yaws: wp.array[wp.vec2d],
    fits: wp.array2d[wp.uint32],
):
    """Finds the orientations in which the footprint at the center of a cell is free; thread ``j`` does row j.

    The footprint is covered by discs with the centers ``x_i (cos yaw, sin yaw)``, in pairs ``x_i`` and ``-x_i``. An
    orientation is free if the distance to the nearest obstacle is at least a disc's radius at the center of each disc.
    All orientations are free if the circle of radius ``turning`` is. ``discs`` are the centers at x >= 0, the innermost
    first. Bit k of ``fits`` is orientation k.
    """
    j = wp.tid()
    for i in range(clearance.shape[1]):
        if clearance[j, i] >= turning:
            fits[j, i] = ALL
        elif clearance[j, i] < radii[0] - discs[0]:
            fits[j, i] = wp.uint32(0)
        else:
            both = ALL
            for n in range(discs.shape[0]):
                good = wp.uint64(0)
                for k in range(64):
                    x = wp.float64(i) * cell + discs[n] * yaws[k][0]
                    y = wp.float64(j) * cell + discs[n] * yaws[k][1]
                    if interpolate(clearance, wp.vec2d(), cell, x, y) >= radii[n]:
                        good = good | (wp.uint64(1) << wp.uint64(k))
                both = both & wp.uint32(good) & wp.uint32(good >> wp.uint64(32))
            fits[j, i] = both
