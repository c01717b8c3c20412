"""Warp kernel that follows what moves in lidar scans: see :class:`~rover_rl.envs.mover_tracker.MoverTracker`.

A scan is a ring of readings, counterclockwise. A negative reading is one that no beam covers, which may be of something
nearer. Neighboring readings on one object are a cluster. It counts as the front of a disc, whose edges lie halfway
between the outermost beams on it and those beside it. An edge is real if the beam beside it goes on beyond it. Else
something nearer hides the rest.
"""

from __future__ import annotations

from rover_rl.native.warp import wp

STATE = wp.constant(17)
"""Numbers of a track, as in ``mover_tracker``. All of them are 0 without one."""
EXISTS, X, Y, SPEED_X, SPEED_Y, RADIUS = map(wp.constant, range(6))
"""Numbers of a track: whether it exists, its position, velocity and radius."""
SCANS, UNSEEN, MOVES, LEGS = map(wp.constant, range(6, 10))
"""Number of scans in which it was seen, time since then (s, slower while it is hidden), whether it moves, and how often
two legs were seen."""
START_X, START_Y, VARIANCE, COVARIANCE, SPREAD, MISFIT, WHOLE = map(wp.constant, range(10, 17))
"""Place from which its way is measured, variance of its position, covariance with its velocity, variance of its
velocity, mean square of the errors of predictions, in standard deviations, and how often both edges were real."""
Track = wp.types.vector(length=STATE, dtype=wp.float32)

FIRST, COUNT, NEAR, SIZE, WIDTH = map(wp.constant, range(5))
"""Numbers of a cluster: its first reading, their number, the least range, its radius and its width."""
RIGHT, LEFT, CENTER_X, CENTER_Y, OWNER, NEAREST, COST, CLUSTER = map(wp.constant, range(5, 13))
"""Further numbers of a cluster: whether the edges of its first and last reading are real, its center, its track, the
nearest track and the cost of that, and how many numbers a cluster has."""
Cluster = wp.types.vector(length=CLUSTER, dtype=wp.float32)
NOBODY, TOO_WIDE = wp.constant(-1.0), wp.constant(-2.0)
"""Owners of clusters without a track, and of those that are too wide for one."""

VALLEY, MARGIN, WIDEST = map(wp.constant, (0.15, 0.3, 1.6))
"""Depth of the valley of ranges between two objects close to each other, distance from the largest range within which
no edge is real, and largest extent of a cluster that is tracked (walls are larger), m."""
SMALLEST, LARGEST, SLIM = map(wp.constant, (0.1, 0.8, 0.4))
"""Least and largest radius of a track, and the one below which it may be a person with two legs, m."""
CIRCLE, ESTIMATE = wp.constant(0.05), wp.constant(0.1)
"""Standard deviations of the distance of readings from a circle, and of the first estimate of its center, m."""
LEG, LEG_DEPTH, DEPTH = map(wp.constant, (0.3, 0.1, 0.65))
"""Largest width of a leg, distance of the center of legs from the mean of their readings (m), and that of the center of
another slim object, in radii."""
STANCE, NEIGHBORS = wp.constant(0.6), wp.constant(4)
"""Largest distance of the legs of a person, m, and how many clusters aside the other leg may be."""
WALKED, LEGGED, NARROWS, RADIUS_GAIN = map(wp.constant, (0.005, 0.3, 0.02, 0.1))
"""Shares of scans with two legs from which on a track is a person, and from which on the radius is theirs; by how much
it falls at most from scan to scan (m), and least share of the radius of a new cluster in that of another track."""
TWIN, TWIN_SPEED = wp.constant(0.35), wp.constant(0.6)
"""Distance (m) and difference of the velocities (m/s) of two tracks below which they follow one person."""
NOISE, BEAM_NOISE, PART_NOISE, PAIR_NOISE, LEG_NOISE = map(wp.constant, (0.03, 0.2, 0.1, 0.03, 0.1))
"""Standard deviation of the center of a cluster: the least (m), and what is added in distances of two beams, for a
hidden edge, for two legs, and for a slim track without two legs (m)."""
ACCELERATION, FASTEST, TOP = map(wp.constant, (2.0, 1.5, 3.0))
"""Standard deviations of the acceleration of a track (m/s^2) and of the velocity of a new one, and speed above which a
track is an error (m/s)."""
TURN = wp.constant(2.0)
"""Error of a prediction, in standard deviations, above which an object has turned."""
NEAR_GATE, WIDE, GATE, UNLIKE = map(wp.constant, (0.25, 2.0, 0.9, 0.5))
"""Largest distance of a track from its cluster: what is always allowed (m), what is added in standard deviations of the
predicted position, and the limit (m). What a difference of the radii counts in a distance."""
LOST, DOUBT, HIDDEN = map(wp.constant, (0.3, 0.5, 0.17))
"""Time without a cluster after which a track ends, s, and how fast it passes for what may lie between two beams, and
for what is behind something else."""
UNKNOWN = wp.constant(0.5)
"""Standard deviation of the position of a track above which it does not count, m."""
SURE, CERTAIN, CONSISTENT = map(wp.constant, (2.0, 0.7, 3.0))
"""What a track that begins to move needs: number of scans, speed in standard deviations, and largest misfit."""
SLOWEST, STILL = wp.constant(0.3), wp.constant(0.2)
"""Speed from which a track begins to move, and below which it rests, m/s."""
WAY, WAY_SHARE, FORGET = map(wp.constant, (0.12, 0.3, 2.0))
"""Least way of a track that begins to move: m, and what is added in distances of two beams. Its start follows it in the
third time, s."""
MOSTLY = wp.constant(0.5)
"""Share of the scans in which both edges were real, above which an object needs not have left its start."""
CLOSE, SPARE, FAR = wp.constant(6.0), wp.constant(8), wp.constant(1.0e4)
"""Distance up to which clusters start tracks first, m, number of tracks that are left for them, and distance of what
does not exist, m."""
GAP, WIDENING = wp.constant(0.15), wp.constant(1.2)
"""Distance of neighboring readings below which they belong together, m, and what is added in distances of two beams."""
STRAIGHT, STRETCH = wp.constant(0.06), wp.constant(4.0)
"""Distance from the line through two readings up to which the next one lies on the same wall, in distances of the two,
and the largest ratio of the distances of the three."""


@wp.struct
class Scans:
    """Scans of all rows, which are added to the tracks of those that are ``due``.

    Ranges are negative where no beam covers them. Poses are x, y and z (m), and IMUs pitch, roll and yaw (rad). The
    ``mounts`` are the positions of the lidars in the base frames of the ``robots``, in which ``beams`` are the
    directions of the readings, and ``angles`` that of the first one, and that between two (rad). From the range
    ``most`` on, a reading has not met anything. ``points`` and ``labels`` are memory for the ends of the readings, and
    for their clusters.
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
    """A scan of a row: readings (m), their ends in the world (m), their clusters, and where the lidar is and looks.

    ``count`` is the number of readings, ``half`` are cosine and sine of half the angle between two beams, ``most`` is
    the largest range that counts (m), and the others are the angle between two beams and that of the first one, and the
    heading (rad).
    """

    ranges: wp.array[float]
    points: wp.array[wp.vec2]
    labels: wp.array[int]
    origin: wp.vec2
    count: int
    half: wp.vec2
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


@wp.func
def is_real(k: int, beside: int, scan: Scan):
    """Returns 1 if the object of reading ``k`` ends there, and 0 if something nearer hides what is ``beside``."""
    return wp.where(scan.ranges[beside] > scan.ranges[k] and scan.ranges[k] < scan.most - MARGIN, 1.0, 0.0)


@wp.func
def turned(way: wp.vec2, cos: float, sin: float):
    return wp.vec2(way[0] * cos - way[1] * sin, way[0] * sin + way[1] * cos)


@wp.func
def center_of(cluster: Cluster, radius: float, scan: Scan):
    """Returns the center of a cluster, if it is the front of a disc.

    With one real edge, the center is at the angle of the radius from there.
    """
    first = int(cluster[FIRST])
    last = around(first + int(cluster[COUNT]) - 1, scan.count)
    reach = cluster[NEAR] + radius
    side = cluster[RIGHT] - cluster[LEFT]
    if side == 0.0:
        return scan.origin + reach * wp.normalize(direction(first, scan) + direction(last, scan))
    # The edge is half a beam aside.
    edge = turned(direction(wp.where(side > 0.0, first, last), scan), scan.half[0], -side * scan.half[1])
    share = radius / reach
    return scan.origin + reach * turned(edge, wp.sqrt(1.0 - share * share), side * share)


@wp.func
def fitted(cluster: Cluster, center: wp.vec2, radius: float, scan: Scan):
    """Returns the center of a disc through the readings of a cluster, near a first estimate.

    Two steps of Gauss and Newton for the sum of the squares of the readings' distances from the circle and of the way
    from the estimate, each by its variance.
    """
    place = wp.vec2(center)
    first = int(cluster[FIRST])
    for _ in range(2):
        weight = (CIRCLE / ESTIMATE) * (CIRCLE / ESTIMATE)
        xx = float(weight)
        xy = float(0.0)
        yy = float(weight)
        x = weight * (center[0] - place[0])
        y = weight * (center[1] - place[1])
        for n in range(int(cluster[COUNT])):
            away = scan.points[around(first + n, scan.count)] - place
            length = wp.max(wp.length(away), 0.01)
            u = away[0] / length
            v = away[1] / length
            xx += u * u
            xy += u * v
            yy += v * v
            x += u * (length - radius)
            y += v * (length - radius)
        det = xx * yy - xy * xy
        place = place + wp.vec2((yy * x - xy * y) / det, (xx * y - xy * x) / det)
    return place


@wp.func
def middle_of(cluster: Cluster, depth: float, scan: Scan):
    """Returns the center of a slim object, ``depth`` (m) behind the mean of its readings."""
    total = wp.vec2(0.0, 0.0)
    for n in range(int(cluster[COUNT])):
        total += scan.points[around(int(cluster[FIRST]) + n, scan.count)]
    mean = total / cluster[COUNT]
    return mean + depth * wp.normalize(mean - scan.origin)


@wp.func
def cluster_of(number: int, first: int, count: int, scan: Scan):
    """Returns the cluster of some readings, which get its number."""
    cluster = Cluster()
    last = around(first + count - 1, scan.count)
    near = float(scan.ranges[first])
    extent = float(0.0)
    for n in range(count):
        k = around(first + n, scan.count)
        scan.labels[k] = number
        near = wp.min(near, scan.ranges[k])
        extent = wp.max(extent, wp.length(scan.points[k] - scan.points[first]))
    cluster[FIRST] = float(first)
    cluster[COUNT] = float(count)
    cluster[NEAR] = near
    cluster[WIDTH] = wp.length(scan.points[last] - scan.points[first])
    cluster[RIGHT] = is_real(first, around(first - 1, scan.count), scan)
    cluster[LEFT] = is_real(last, around(last + 1, scan.count), scan)
    half = wp.sin(wp.min(0.5 * float(count) * scan.spacing, 1.2))
    # The least range is R / sin(half) - R. Boxes are wider than that.
    disc = near * half / (1.0 - half)
    cluster[SIZE] = wp.clamp(wp.min(disc, 0.6 * cluster[WIDTH] + 0.5 * near * scan.spacing), SMALLEST, LARGEST)
    center = center_of(cluster, cluster[SIZE], scan)
    cluster[CENTER_X] = center[0]
    cluster[CENTER_Y] = center[1]
    cluster[OWNER] = wp.where(extent < WIDEST, NOBODY, TOO_WIDE)
    return cluster


@wp.func
def belongs_before(k: int, scan: Scan):
    """Returns 1 if the bottom of a valley belongs to the object before it, and 0 if to the one after it."""
    before = wp.length(scan.points[k] - scan.points[around(k - 1, scan.count)])
    return wp.where(wp.length(scan.points[around(k + 1, scan.count)] - scan.points[k]) > before, 1, 0)


@wp.func
def find_clusters(scan: Scan, clusters: wp.array[Cluster]):
    """Finds the clusters of a scan and returns their number.

    They end at gaps, and at valleys: along a convex object the ranges fall, then rise.
    """
    start = first_gap(scan)
    count = int(0)
    # First reading of the cluster and bottom of the valley, from the start, and the nearest and the deepest range.
    first = int(0)
    bottom = int(0)
    low = float(FAR)
    deep = float(0.0)
    for n in range(scan.count):
        k = around(start + n, scan.count)
        value = scan.ranges[k]
        if value < low or value > deep:
            low = wp.min(low, value)
            deep = value
            bottom = n
        if deep - wp.max(low, value) > VALLEY:
            end = bottom + belongs_before(around(start + bottom, scan.count), scan)
            clusters[count] = cluster_of(count, around(start + first, scan.count), end - first, scan)
            count += 1
            first = end
            low = value
            deep = value
            bottom = n
        if n == scan.count - 1 or not linked(k, scan):
            if value >= 0.0 and value < scan.most:
                clusters[count] = cluster_of(count, around(start + first, scan.count), n + 1 - first, scan)
                count += 1
            first = n + 1
            low = float(FAR)
            deep = float(0.0)
    return count


@wp.func
def is_leg(cluster: Cluster):
    return cluster[WIDTH] < LEG and cluster[OWNER] > TOO_WIDE


@wp.func
def predicted(track: Track, dt: float):
    after = Track(track)
    after[X] = track[X] + dt * track[SPEED_X]
    after[Y] = track[Y] + dt * track[SPEED_Y]
    noise = ACCELERATION * ACCELERATION * dt * dt
    after[VARIANCE] = track[VARIANCE] + 2.0 * dt * track[COVARIANCE] + dt * dt * track[SPREAD] + 0.25 * noise * dt * dt
    after[COVARIANCE] = track[COVARIANCE] + dt * track[SPREAD] + 0.5 * noise * dt
    after[SPREAD] = track[SPREAD] + noise
    return after


@wp.func
def cost(track: Track, cluster: Cluster, gate: float, scan: Scan):
    """Returns the distance of a track from a cluster (m), ``FAR`` if they cannot belong together."""
    place = wp.vec2(track[X], track[Y])
    center = wp.vec2(cluster[CENTER_X], cluster[CENTER_Y])
    unlike = wp.abs(cluster[SIZE] - track[RADIUS])
    is_part = cluster[RIGHT] + cluster[LEFT] < 2.0
    # The center of a part changes with the radius.
    most = wp.where(is_part, gate + 1.5 * unlike, gate)
    if cluster[OWNER] != NOBODY or wp.length_sq(center - place) > most * most:
        return FAR
    if is_part:
        center = center_of(cluster, track[RADIUS], scan)
        unlike = 0.0
    distance = wp.length(center - place)
    return wp.where(distance < gate, distance + UNLIKE * unlike, FAR)


@wp.func
def beam_at(place: wp.vec2, scan: Scan):
    """Returns the number of the beam on the right of a place; the next one is on its left."""
    away = place - scan.origin
    turn = (wp.atan2(away[1], away[0]) - scan.yaw - scan.offset) / scan.spacing
    rounds = wp.floor(turn / float(scan.count))
    return wp.clamp(int(wp.floor(turn - rounds * float(scan.count))), 0, scan.count - 1)


@wp.func
def assign(
    states: wp.array[Track],
    clusters: wp.array[Cluster],
    count: int,
    scan: Scan,
    wishes: wp.array[int],
    seen: wp.array[int],
):
    """Gives clusters to tracks that are each other's nearest; ``seen`` are the clusters of the tracks, or -1."""
    for c in range(count):
        clusters[c][COST] = FAR
    for t in range(states.shape[0]):
        track = states[t]
        if track[EXISTS] > 0.0 and seen[t] < 0 and wishes[t] >= 0:
            wishes[t] = -1
            best = float(FAR)
            gate = wp.min(NEAR_GATE + WIDE * wp.sqrt(track[VARIANCE]), GATE)
            place = wp.vec2(track[X], track[Y])
            # Beams that may end within the gate.
            angle = 1.1 * (gate + track[RADIUS]) / wp.max(wp.length(place - scan.origin), 0.1)
            wide = wp.min(int(angle / scan.spacing) + 1, scan.count / 2 - 1)
            middle = beam_at(place, scan)
            last = int(-1)
            for n in range(-wide, wide + 2):
                c = scan.labels[around(middle + n, scan.count)]
                if c >= 0 and c != last:
                    last = c
                    value = cost(track, clusters[c], gate, scan)
                    if value < best:
                        best = value
                        wishes[t] = c
                    if value < clusters[c][COST]:
                        clusters[c][COST] = value
                        clusters[c][NEAREST] = float(t)
    for t in range(states.shape[0]):
        c = wishes[t]
        if c >= 0 and states[t][EXISTS] > 0.0 and seen[t] < 0:
            if int(clusters[c][NEAREST]) == t:
                seen[t] = c
                clusters[c][OWNER] = float(t)


@wp.func
def other_leg(main: int, place: wp.vec2, clusters: wp.array[Cluster], count: int):
    """Returns the free cluster that may be the other leg of a cluster's, nearest to where the person is, or -1."""
    best = float(STANCE)
    found = int(-1)
    leg = clusters[main]
    if is_leg(leg):
        for n in range(-NEIGHBORS, NEIGHBORS + 1):
            c = (main + n + NEIGHBORS * count) % count
            other = clusters[c]
            if c != main and other[OWNER] == NOBODY and is_leg(other):
                apart = wp.length(wp.vec2(other[CENTER_X] - leg[CENTER_X], other[CENTER_Y] - leg[CENTER_Y]))
                value = wp.length(wp.vec2(other[CENTER_X], other[CENTER_Y]) - place)
                if apart < STANCE and value < best:
                    best = value
                    found = c
    return found


@wp.func
def between(one: Cluster, two: Cluster):
    """Returns the center and the radius of a person with two legs: x, y and radius."""
    center = wp.vec2(one[CENTER_X] + two[CENTER_X], one[CENTER_Y] + two[CENTER_Y]) / 2.0
    apart = wp.length(wp.vec2(one[CENTER_X] - two[CENTER_X], one[CENTER_Y] - two[CENTER_Y]))
    return wp.vec3(center[0], center[1], wp.min(0.5 * apart + wp.max(one[SIZE], two[SIZE]), LARGEST))


@wp.func
def noise_of(cluster: Cluster, both: bool, radius: float, spacing: float):
    noise = NOISE + BEAM_NOISE * spacing * cluster[NEAR]
    noise += wp.where(cluster[RIGHT] + cluster[LEFT] < 2.0, PART_NOISE, 0.0)
    return noise + wp.where(both, PAIR_NOISE, wp.where(radius < SLIM, LEG_NOISE, 0.0))


@wp.func
def corrected(track: Track, center: wp.vec2, noise: float, dt: float):
    after = Track(track)
    ahead_x = center[0] - track[X]
    ahead_y = center[1] - track[Y]
    square = ahead_x * ahead_x + ahead_y * ahead_y
    a = track[VARIANCE]
    b = track[COVARIANCE]
    c = track[SPREAD]
    expected = a + noise * noise
    after[MISFIT] = track[MISFIT] + 0.3 * (wp.min(0.5 * square / expected, 10.0) - track[MISFIT])
    if square > TURN * TURN * expected:
        # It has turned, or has been pushed: its velocity is known no more.
        a = wp.max(a, 0.5 * square)
        c = wp.max(c, 0.5 * square / (dt * dt))
        b = 0.7 * wp.sqrt(a * c)
        expected = a + noise * noise
    gain = a / expected
    rate = b / expected
    after[X] = track[X] + gain * ahead_x
    after[Y] = track[Y] + gain * ahead_y
    after[SPEED_X] = track[SPEED_X] + rate * ahead_x
    after[SPEED_Y] = track[SPEED_Y] + rate * ahead_y
    after[VARIANCE] = (1.0 - gain) * a
    after[COVARIANCE] = (1.0 - gain) * b
    after[SPREAD] = c - rate * b
    after[SCANS] = track[SCANS] + 1.0
    after[UNSEEN] = 0.0
    return after


@wp.func
def center_for(cluster: Cluster, radius: float, legs: float, scan: Scan):
    """Returns the center of the cluster of a track with some radius."""
    if legs > WALKED:
        # Legs hide each other, so that their front is no circle.
        return middle_of(cluster, LEG_DEPTH, scan)
    if radius < SLIM and cluster[RIGHT] * cluster[LEFT] > 0.0:
        return middle_of(cluster, DEPTH * radius, scan)
    return fitted(cluster, center_of(cluster, radius, scan), radius, scan)


@wp.func
def followed(t: int, track: Track, main: int, scan: Scan, clusters: wp.array[Cluster], count: int, dt: float):
    """Returns a track after it has been seen as a cluster. A second leg becomes the track's, too."""
    after = Track(track)
    cluster = clusters[main]
    whole = cluster[RIGHT] * cluster[LEFT]
    center = wp.vec2(0.0, 0.0)
    other = other_leg(main, wp.vec2(track[X], track[Y]), clusters, count)
    if other >= 0:
        clusters[other][OWNER] = float(t)
        person = between(cluster, clusters[other])
        center = wp.vec2(person[0], person[1])
        after[RADIUS] = wp.max(track[RADIUS] - NARROWS, person[2])
    else:
        if whole > 0.0 and track[LEGS] < LEGGED:
            gain = wp.max(1.0 / (track[SCANS] + 1.0), RADIUS_GAIN)
            after[RADIUS] = track[RADIUS] + gain * (cluster[SIZE] - track[RADIUS])
        center = center_for(cluster, after[RADIUS], track[LEGS], scan)
    after[WHOLE] = track[WHOLE] + 0.3 * (whole - track[WHOLE])
    after[LEGS] = track[LEGS] + 0.2 * (wp.where(other >= 0, 1.0, 0.0) - track[LEGS])
    return corrected(after, center, noise_of(cluster, other >= 0, track[RADIUS], scan.spacing), dt)


@wp.func
def missed(track: Track, scan: Scan, dt: float):
    """Returns a track that has not been seen. It ends soon if it should have been."""
    after = Track(track)
    place = wp.vec2(track[X], track[Y])
    distance = wp.length(place - scan.origin)
    k = beam_at(place, scan)
    pace = float(1.0)
    if wp.min(scan.ranges[k], scan.ranges[around(k + 1, scan.count)]) < distance + 0.5 * track[RADIUS]:
        pace = HIDDEN
    elif track[RADIUS] < scan.spacing * distance or track[LEGS] > LEGGED:
        pace = DOUBT
    if track[SCANS] < SURE:
        pace = 1.0
    after[UNSEEN] = track[UNSEEN] + pace * dt
    after[EXISTS] = wp.where(after[UNSEEN] < LOST, 1.0, 0.0)
    return after


@wp.func
def has_left(x: float, y: float, scan: Scan):
    place = wp.vec2(x, y)
    k = beam_at(place, scan)
    return wp.min(scan.ranges[k], scan.ranges[around(k + 1, scan.count)]) > wp.length(place - scan.origin)


@wp.func
def with_motion(track: Track, scan: Scan, dt: float):
    after = Track(track)
    speed = wp.length(wp.vec2(track[SPEED_X], track[SPEED_Y]))
    way_x = track[X] - track[START_X]
    way_y = track[Y] - track[START_Y]
    away = wp.length(wp.vec2(track[X], track[Y]) - scan.origin)
    share = wp.min(dt / FORGET, 1.0)
    after[START_X] = track[START_X] + share * way_x
    after[START_Y] = track[START_Y] + share * way_y
    if track[MOVES] > 0.0:
        after[MOVES] = wp.where(speed > STILL, 1.0, 0.0)
    else:
        begins = track[SCANS] >= SURE and speed > wp.max(SLOWEST, CERTAIN * wp.sqrt(track[SPREAD]))
        free = track[WHOLE] > MOSTLY or has_left(track[START_X], track[START_Y], scan)
        far = wp.length(wp.vec2(way_x, way_y)) > WAY + WAY_SHARE * scan.spacing * away
        after[MOVES] = wp.where(begins and far and track[MISFIT] < CONSISTENT and free, 1.0, 0.0)
    return after


@wp.func
def is_known(track: Track):
    """Returns whether a track moves and its place and velocity are known well enough."""
    speed = wp.length(wp.vec2(track[SPEED_X], track[SPEED_Y]))
    return track[MOVES] > 0.0 and track[VARIANCE] < UNKNOWN * UNKNOWN and speed < TOP


@wp.func
def started(t: int, main: int, clusters: wp.array[Cluster], count: int, spacing: float):
    """Returns the new track of a cluster, which becomes its own."""
    cluster = clusters[main]
    clusters[main][OWNER] = float(t)
    center = wp.vec2(cluster[CENTER_X], cluster[CENTER_Y])
    track = Track()
    track[RADIUS] = cluster[SIZE]
    other = other_leg(main, center, clusters, count)
    if other >= 0:
        clusters[other][OWNER] = float(t)
        person = between(cluster, clusters[other])
        center = wp.vec2(person[0], person[1])
        track[RADIUS] = person[2]
        track[LEGS] = 0.5
    noise = noise_of(cluster, other >= 0, track[RADIUS], spacing)
    track[EXISTS] = 1.0
    track[X] = center[0]
    track[Y] = center[1]
    track[START_X] = center[0]
    track[START_Y] = center[1]
    track[SCANS] = 1.0
    track[VARIANCE] = noise * noise
    track[SPREAD] = FASTEST * FASTEST
    track[MISFIT] = 1.0
    track[WHOLE] = cluster[RIGHT] * cluster[LEFT]
    return track


@wp.func
def are_twins(one: Track, two: Track):
    """Returns whether two tracks follow the legs of one person."""
    apart = wp.vec2(one[X] - two[X], one[Y] - two[Y])
    unlike = wp.vec2(one[SPEED_X] - two[SPEED_X], one[SPEED_Y] - two[SPEED_Y])
    near = wp.length_sq(apart) < TWIN * TWIN and wp.length_sq(unlike) < TWIN_SPEED * TWIN_SPEED
    return near and wp.max(one[RADIUS], two[RADIUS]) < SLIM


@wp.func
def end_twins(states: wp.array[Track], clusters: wp.array[Cluster], count: int):
    """Ends the younger one of two tracks of one person."""
    for c in range(count):
        for n in range(1, wp.min(NEIGHBORS + 1, count)):
            t = int(clusters[c][OWNER])
            other = int(clusters[around(c + n, count)][OWNER])
            if wp.min(t, other) >= 0 and t != other:
                one = states[t]
                two = states[other]
                if one[EXISTS] * two[EXISTS] > 0.0 and are_twins(one, two):
                    states[wp.where(one[SCANS] < two[SCANS], t, other)] = Track()


@wp.func
def may_start(cluster: Cluster):
    """Returns whether a cluster starts a track: two readings with a real edge, or one with two."""
    edges = cluster[RIGHT] + cluster[LEFT]
    return cluster[OWNER] == NOBODY and edges > wp.where(cluster[COUNT] > 1.0, 0.0, 1.0)


@wp.func
def start_tracks(states: wp.array[Track], clusters: wp.array[Cluster], count: int, spacing: float):
    """Starts tracks of the clusters that have none, where there is room: first those that are close, then others."""
    for far in range(2):
        t = int(0)
        for c in range(count):
            if may_start(clusters[c]) and (far == 1 or clusters[c][NEAR] < CLOSE):
                while t < states.shape[0] - SPARE * far and states[t][EXISTS] > 0.0:
                    t += 1
                if t < states.shape[0] - SPARE * far:
                    states[t] = started(t, c, clusters, count, spacing)


@wp.func
def mark_readings(
    scan: Scan, states: wp.array[Track], clusters: wp.array[Cluster], count: int, readings: wp.array[wp.bool]
):
    """Sets which readings belong to a track that moves."""
    for k in range(scan.count):
        readings[k] = False
    for c in range(count):
        cluster = clusters[c]
        owner = int(cluster[OWNER])
        if owner >= 0:
            if is_known(states[owner]):
                for n in range(int(cluster[COUNT])):
                    readings[around(int(cluster[FIRST]) + n, scan.count)] = True


@wp.kernel
def follow(
    scans: Scans,
    clusters: wp.array2d[Cluster],
    seens: wp.array3d[int],
    states: wp.array2d[Track],
    moves: wp.array2d[wp.bool],
    readings: wp.array2d[wp.bool],
    first: int,
):
    """Adds a scan to the tracks of each row that is ``due``; thread ``t`` does row ``first + t``.

    ``states`` are the tracks, ``[N, TRACKS]``. ``moves`` says which of them move, and ``readings``, ``[N, P]``, which
    readings belong to one that moves. ``clusters``, ``[N, P]``, and ``seens``, those of the tracks, ``[N, 2, TRACKS]``,
    are memory.
    """
    i = first + wp.tid()
    if not scans.due[i]:
        return
    scan = scan_of(scans, i)
    dt = scans.dt
    count = find_clusters(scan, clusters[i])
    for t in range(states.shape[1]):
        states[i, t] = predicted(states[i, t], dt)
        seens[i, 0, t] = 0
        seens[i, 1, t] = -1
    for _ in range(2):
        assign(states[i], clusters[i], count, scan, seens[i, 0], seens[i, 1])
    for t in range(states.shape[1]):
        track = states[i, t]
        if track[EXISTS] > 0.0:
            if seens[i, 1, t] >= 0:
                track = followed(t, track, seens[i, 1, t], scan, clusters[i], count, dt)
            else:
                track = missed(track, scan, dt)
            states[i, t] = with_motion(track, scan, dt)
        if track[EXISTS] == 0.0:
            states[i, t] = Track()
    end_twins(states[i], clusters[i], count)
    start_tracks(states[i], clusters[i], count, scan.spacing)
    for t in range(states.shape[1]):
        moves[i, t] = is_known(states[i, t])
    mark_readings(scan, states[i], clusters[i], count, readings[i])
