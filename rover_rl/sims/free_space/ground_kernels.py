"""Warp kernels that test the ground for a rover: slopes, and headings at rest."""

from __future__ import annotations

from rover_rl.sims.native.warp import wp
from rover_rl.sims.worlds.ground_kernels import Ground, plane_at

RINGS = wp.constant(4)
"""Number of rings of test points around a cell."""


@wp.kernel
def measure_slopes(
    ground: Ground,
    xs: wp.array[wp.float64],
    ys: wp.array[wp.float64],
    around: wp.array[wp.vec2d],
    slopes: wp.array2d[wp.float64],
):
    """Steepest slope around the centers of cells; thread ``j`` does row j.

    Args:
        ground: terrain.
        xs: x of each column, m.
        ys: y of each row, m.
        around: points relative to a center at which the slope counts, m.
        slopes: results: square of the gradient, ``[rows, columns]``.
    """
    j = wp.tid()
    for i in range(xs.shape[0]):
        steepest = wp.float64(0.0)
        for n in range(around.shape[0]):
            plane = plane_at(ground, xs[i] + around[n][0], ys[j] + around[n][1])
            steepest = wp.max(steepest, plane[1] * plane[1] + plane[2] * plane[2])
        slopes[j, i] = steepest


@wp.struct
class Stance:
    """Dimensions of a rover and the limits for its rest on the ground.

    Attributes:
        wheels: x, y of the wheels relative to their mean, m.
        middle: mean x, y of the wheels, m.
        spread: sums of the squares of ``wheels`` along x and y, m^2.
        lidar: position of the lidar, m.
        upright: least z of the rover's up axis.
        reach: radius of the outermost ring of test points, m.
        gap: least height of the scan plane above the ground, m.
    """

    wheels: wp.array[wp.vec2d]
    middle: wp.vec2d
    spread: wp.vec2d
    lidar: wp.vec3d
    upright: wp.float64
    reach: wp.float64
    gap: wp.float64


@wp.func
def deviation(ground: Ground, at: wp.vec2d, slope: wp.vec2d, radius: wp.float64) -> wp.vec2d:
    """Lowest and highest ground in a square around a point, relative to a plane through height 0 at the point.

    The ground consists of triangles, so that its extremes relative to a plane are at the vertices. Returns infinite
    values if the square exceeds the terrain.
    """
    low = wp.float64(wp.inf)
    high = wp.float64(-wp.inf)
    first_i = int(wp.floor((at[0] - radius - ground.origin[0]) / ground.cell))
    first_j = int(wp.floor((at[1] - radius - ground.origin[1]) / ground.cell))
    last_i = int(wp.ceil((at[0] + radius - ground.origin[0]) / ground.cell))
    last_j = int(wp.ceil((at[1] + radius - ground.origin[1]) / ground.cell))
    if first_i < 0 or first_j < 0 or last_i >= ground.heights.shape[1] or last_j >= ground.heights.shape[0]:
        return wp.vec2d(-low, -high)
    for j in range(first_j, last_j + 1):
        y = ground.origin[1] + wp.float64(j) * ground.cell - at[1]
        for i in range(first_i, last_i + 1):
            x = ground.origin[0] + wp.float64(i) * ground.cell - at[0]
            height = wp.float64(ground.heights[j, i]) - slope[0] * x - slope[1] * y
            low = wp.min(low, height)
            high = wp.max(high, height)
    return wp.vec2d(low, high)


@wp.kernel
def find_level_cells(ground: Ground, stance: Stance, cells: wp.array[wp.vec2d], level: wp.array[wp.bool]):
    """Finds cells on ground so level that :func:`find_rest_headings` allows all headings; thread ``t`` does cell ``t``.

    The ground around the center lies between two planes of slope s: by ``[a, b]`` within the wheels' distance, and
    below B within reach. The plane fitted below the wheels then has a slope g with ``|g - s| <= e``, where e follows
    from ``(b - a) / 2`` and the wheels' leverage, ``sum |x| / sum x^2`` along both axes. So the scan plane is at least
    ``a - e |middle| + lidar_z - e reach - B`` above the ground.

    Args:
        ground: terrain.
        stance: rover and limits.
        cells: centers of the cells, m.
        level: results.
    """
    t = wp.tid()
    at = cells[t]
    wheel = wp.float64(0.0)
    leverage = wp.vec2d()
    for n in range(stance.wheels.shape[0]):
        arm = stance.wheels[n]
        wheel = wp.max(wheel, wp.length(arm + stance.middle))
        leverage += wp.vec2d(wp.abs(arm[0]) / stance.spread[0], wp.abs(arm[1]) / stance.spread[1])
    east = plane_at(ground, at[0] + wheel, at[1])[0]
    west = plane_at(ground, at[0] - wheel, at[1])[0]
    north = plane_at(ground, at[0], at[1] + wheel)[0]
    south = plane_at(ground, at[0], at[1] - wheel)[0]
    slope = wp.vec2d(east - west, north - south) / (wp.float64(2.0) * wheel)
    near = deviation(ground, at, slope, wheel)
    far = deviation(ground, at, slope, stance.reach)
    error = wp.length(leverage) * (near[1] - near[0]) / wp.float64(2.0)
    # The cosine of the steepest possible tilt.
    steepest = wp.length(slope) + error
    upright = wp.float64(1.0) / wp.sqrt(wp.float64(1.0) + steepest * steepest)
    height = near[0] + stance.lidar[2] - error * (wp.length(stance.middle) + stance.reach) - far[1]
    level[t] = upright > stance.upright and height > stance.gap


@wp.func
def fit_plane(ground: Ground, stance: Stance, at: wp.vec2d, ahead: wp.vec2d) -> wp.vec3d:
    """Plane through the ground below the wheels, as :func:`rover_rl.sims.free_space.rest_pose.ground_frame`.

    Returns its height at the rover (m), and its slopes forward and to the left.
    """
    total = wp.float64(0.0)
    forward = wp.float64(0.0)
    left = wp.float64(0.0)
    count = stance.wheels.shape[0]
    for n in range(count):
        arm = stance.wheels[n]
        x = arm[0] + stance.middle[0]
        y = arm[1] + stance.middle[1]
        height = plane_at(ground, at[0] + x * ahead[0] - y * ahead[1], at[1] + x * ahead[1] + y * ahead[0])[0]
        total += height
        forward += height * arm[0]
        left += height * arm[1]
    forward = forward / stance.spread[0]
    left = left / stance.spread[1]
    mean = total / wp.float64(count)
    return wp.vec3d(mean - forward * stance.middle[0] - left * stance.middle[1], forward, left)


@wp.kernel
def find_rest_headings(
    ground: Ground,
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
    plane is above the ground at all test points, which lie on four rings around the center.

    Args:
        ground: terrain.
        stance: rover and limits.
        cells: centers of the cells, m.
        ring: unit vectors to the points of a ring.
        yaws: cosine and sine of the headings.
        surface: working memory for the height of the ground at the test points, ``[cells, rings * points]``.
        offsets: results: position of the lidar relative to the center, ``[cells, headings]``, m.
        headings: results.
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
            height = plane_at(ground, at[0] + p[0], at[1] + p[1])[0]
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
