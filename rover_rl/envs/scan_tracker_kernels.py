"""Warp structures and functions for lidar scans in which something is followed.

A scan is a ring of readings, counterclockwise. A negative reading is one that no beam covers, which may be of something
nearer.
"""

from __future__ import annotations

from rover_rl.native.warp import wp

GAP, WIDENING = wp.constant(0.15), wp.constant(1.2)
"""Distance of neighboring readings below which they belong together, m, and what is added in distances of two beams."""
STRAIGHT, STRETCH = wp.constant(0.06), wp.constant(4.0)
"""Distance from the line through two readings up to which the next one lies on the same wall, in distances of the two,
and the largest ratio of the distances of the three."""


@wp.struct
class Scans:
    """Scans of all rows.

    Attributes:
        due: rows whose scan is added. The tracks of the others stay as they are.
        ranges: readings, ``[N, P]``, m; negative where no beam covers one.
        poses: x, y and z of the rovers, m.
        imus: pitch, roll and yaw of the rovers, rad.
        mounts: positions of the lidars in the base frames of the robots, m.
        robots: number of each row's robot.
        beams: directions of the readings in the base frame, ``[P]``.
        angles: angle of the first reading, and that between two, rad.
        most: range from which on a reading has not met anything, m.
        dt: time since the last scan, s.
        points: memory for the ends of the readings, ``[N, P]``.
        labels: memory for the clusters of the readings, ``[N, P]``.
    """

    due: wp.array[wp.bool]
    ranges: wp.array2d[float]
    poses: wp.array2d[float]
    imus: wp.array2d[float]
    mounts: wp.array[wp.vec2]
    robots: wp.array[wp.int64]
    beams: wp.array[wp.vec2]
    angles: wp.vec2
    most: float
    dt: float
    points: wp.array2d[wp.vec2]
    labels: wp.array2d[int]


@wp.struct
class Scan:
    """A scan of a row: readings (m), their ends in the world (m), their clusters, and where the lidar is and looks."""

    ranges: wp.array[float]
    points: wp.array[wp.vec2]
    labels: wp.array[int]
    origin: wp.vec2
    # Number of readings.
    count: int
    # Cosine and sine of half the angle between two beams.
    half: wp.vec2
    # Largest range that counts, m, angle between two beams and that of the first one, and heading, rad.
    most: float
    spacing: float
    offset: float
    yaw: float


@wp.func
def around(k: int, count: int):
    """Returns the number of one of ``count`` readings in the ring, at most once around."""
    return wp.where(k < 0, k + count, wp.where(k < count, k, k - count))


@wp.func
def goes_on(a: int, b: int, c: int, scan: Scan):
    """Returns whether three readings lie on a straight wall."""
    if wp.max(scan.ranges[a], wp.max(scan.ranges[b], scan.ranges[c])) >= scan.most:
        return False
    if wp.min(scan.ranges[a], wp.min(scan.ranges[b], scan.ranges[c])) < 0.0:
        return False
    step = scan.points[b] - scan.points[a]
    ahead = scan.points[c] - scan.points[b]
    known = wp.length(step)
    length = wp.length(ahead)
    aside = wp.abs(step[0] * ahead[1] - step[1] * ahead[0])
    near = length < STRETCH * known and known < STRETCH * length
    return near and aside < STRAIGHT * known and wp.dot(step, ahead) > 0.0


@wp.func
def linked(k: int, scan: Scan):
    """Returns whether reading ``k`` and the next one are on one object."""
    after = around(k + 1, scan.count)
    near = wp.min(scan.ranges[k], scan.ranges[after])
    if wp.max(scan.ranges[k], scan.ranges[after]) >= scan.most or near < 0.0:
        return False
    if wp.length(scan.points[after] - scan.points[k]) < GAP + WIDENING * scan.spacing * near:
        return True
    # Beams that graze a wall end far from each other.
    return goes_on(around(k - 1, scan.count), k, after, scan) or goes_on(k, after, around(k + 2, scan.count), scan)


@wp.func
def direction(k: int, scan: Scan):
    """Returns the direction of a beam in the world."""
    return (scan.points[k] - scan.origin) / wp.max(scan.ranges[k], 1.0e-3)


@wp.func
def first_gap(scan: Scan):
    """Returns the number of the first reading that is not linked to the one before, or of the last reading."""
    k = int(0)
    while k < scan.count - 1 and linked(around(k - 1, scan.count), scan):
        k += 1
    return k


@wp.func
def scan_of(scans: Scans, row: int):
    """Returns a row's scan, with no clusters, and sets the ends of its readings."""
    scan = Scan()
    scan.ranges = scans.ranges[row]
    scan.count = scan.ranges.shape[0]
    scan.points = scans.points[row]
    scan.labels = scans.labels[row]
    scan.most = scans.most
    scan.offset = scans.angles[0]
    scan.spacing = scans.angles[1]
    scan.half = wp.vec2(wp.cos(0.5 * scan.spacing), wp.sin(0.5 * scan.spacing))
    scan.yaw = scans.imus[row, 2]
    cos = wp.cos(scan.yaw)
    sin = wp.sin(scan.yaw)
    mount = scans.mounts[scans.robots[row]]
    x = scans.poses[row, 0] + cos * mount[0] - sin * mount[1]
    y = scans.poses[row, 1] + sin * mount[0] + cos * mount[1]
    scan.origin = wp.vec2(x, y)
    for k in range(scan.count):
        u = scans.beams[k][0]
        v = scans.beams[k][1]
        scan.labels[k] = -1
        scan.points[k] = scan.origin + scan.ranges[k] * wp.vec2(cos * u - sin * v, sin * u + cos * v)
    return scan
