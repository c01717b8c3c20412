"""Warp kernel that follows long things which move broadside: see :class:`~rover_rl.envs.wall_tracker.WallTracker`.

A wall is a line with two ends. Its place along the line is not known, as most of it may be hidden: what is followed is
the distance along its normal. Scans are those of :mod:`~rover_rl.envs.scan_tracker_kernels`.
"""

from __future__ import annotations

from rover_rl.envs.scan_tracker_kernels import Scan, Scans, around, direction, first_gap, linked, scan_of
from rover_rl.native.warp import wp

STATE = wp.constant(20)
"""Numbers of a track, as in ``wall_tracker``. All of them are 0 without one."""
EXISTS, X, Y, ALONG_X, ALONG_Y, LOW, HIGH, SPEED = map(wp.constant, range(8))
"""Numbers of a track: whether it exists, a point on it, its direction, where it ends on both sides of the point, and
its velocity along the normal, which is on the left of the direction."""
VARIANCE, COVARIANCE, SPREAD, MISFIT, TURN = map(wp.constant, range(8, 13))
"""Variance of its distance along the normal, covariance with its velocity, variance of its velocity, mean square of the
errors of predictions, in standard deviations, and variance of its direction."""
SCANS, UNSEEN, MOVES, WAY, SIDE, HEIGHT, RISE = map(wp.constant, range(13, 20))
"""Number of scans in which it was seen, time since then (s), whether it moves, its way along the normal, on which side
of it the lidar was, at which height the beams met it, and by how much that has changed on its way."""
Track = wp.types.vector(length=STATE, dtype=wp.float32)

MEAN_X, MEAN_Y, UNIT_X, UNIT_Y, RIGHT, LEFT, WEIGHT, OWNER, COST = map(wp.constant, range(9))
"""Numbers of a straight part of a scan: the mean of its readings, its direction, its ends on both sides of the mean,
the sum of the squares of the readings' distances from the mean, its track or ``NOBODY``, and how far that is."""
PART = wp.constant(9)
"""Numbers of a part."""
Part = wp.types.vector(length=PART, dtype=wp.float32)
NOBODY = wp.constant(-1.0)
"""Owner of a part without a track."""

BEND, BEND_SHARE = wp.constant(0.02), wp.constant(0.06)
"""Distance of a reading from the line through the ends above which a part is cut, m, and what is added for a beam along
the normal: the error of a range counts less where a beam grazes a wall."""
STEP = wp.constant(1.2)
"""Largest distance of neighboring readings of a part, m."""
ASIDE = wp.constant(0.03)
"""Distance of the outermost reading from the line through the others above which it is on another side, m."""
SHORTEST, LEAST = wp.constant(0.6), wp.constant(3)
"""Least length of a part, m, and least number of its readings."""
NOISE, FASTEST, ACCELERATION = wp.constant(0.03), wp.constant(1.5), wp.constant(1.5)
"""Standard deviations of the distance of a part (m), of the velocity of a new track (m/s) and of the acceleration of a
track, m/s^2."""
WANDERS, BENT = wp.constant(0.1), wp.constant(0.02)
"""Standard deviation of the direction of a track after a second, and least one of that of a part, rad."""
PARALLEL = wp.constant(0.2)
"""Sine of the largest angle between a track and its part."""
NEAR_GATE, WIDE, GATE = wp.constant(0.1), wp.constant(2.0), wp.constant(0.45)
"""Largest distance of a track from its part: what is always allowed (m), what is added in standard deviations of the
prediction, and the limit (m)."""
APART = wp.constant(0.4)
"""Largest gap along the line between a track and its part, m."""
JOINT = wp.constant(0.12)
"""Distance from a track below which another part belongs to it, too, m."""
THICK = wp.constant(0.1)
"""By how much the distance changes where the lidar sees the other side, m."""
JUMP = wp.constant(3.5)
"""Error of a prediction, in standard deviations, above which the velocity is unknown again."""
RECENT = wp.constant(0.3)
"""Share of the last scan in the mean square of the errors of predictions."""
BEYOND, INNER, INLINE = wp.constant(0.15), wp.constant(0.15), wp.constant(0.1)
"""How far a beam must end beyond a wall so that it passes there (m), how far from its ends, m, and distance of the
lidar from its line below which nobody can tell, m."""
PASSING = wp.constant(2)
"""Number of beams that pass after which a track ends."""
HIDDEN = wp.constant(1.05)
"""Time after which a track that moves ends if it has not been seen, s. Others end at once."""
UNKNOWN = wp.constant(0.35)
"""Standard deviation of the distance of a track above which it does not count, m."""
SURE, CERTAIN, CONSISTENT = wp.constant(3.0), wp.constant(2.0), wp.constant(1.2)
"""What a track that begins to move needs: number of scans, speed in standard deviations, and largest misfit."""
WRONG = wp.constant(2.4)
"""Misfit from which on a track rests."""
SLOWEST, STILL, TOP = wp.constant(0.3), wp.constant(0.2), wp.constant(3.0)
"""Speed from which a track begins to move, below which it rests, and above which it is an error, m/s."""
LEAST_WAY, FORGET = wp.constant(0.12), wp.constant(2.0)
"""Least way of a track that begins to move, m, and time in which two thirds of a way are forgotten, s."""
LEVEL = wp.constant(0.035)
"""Slope of the beams above which no track begins to move."""
STEEP = wp.constant(8.0)
"""Way for a change of the height. Where beams meet sloping ground, the line moves as they rise: it is no wall."""
FAR = wp.constant(1.0e4)
"""Distance of what does not exist, m."""


@wp.func
def normal(along: wp.vec2):
    """Returns the direction on the left."""
    return wp.vec2(-along[1], along[0])


@wp.func
def farthest(first: int, steps: int, scan: Scan):
    """Returns which of the readings up to ``first + steps`` is too far from the line through both, or 0."""
    begin = scan.points[around(first, scan.count)]
    chord = scan.points[around(first + steps, scan.count)] - begin
    aside = normal(wp.normalize(chord))
    most = float(0.0)
    found = int(0)
    for n in range(1, steps):
        k = around(first + n, scan.count)
        away = wp.abs(wp.dot(scan.points[k] - begin, aside)) - BEND
        away -= BEND_SHARE * wp.abs(wp.dot(direction(k, scan), aside))
        if away > most:
            most = away
            found = n
    return found


@wp.func
def line_of(first: int, steps: int, scan: Scan):
    """Returns the part with the readings up to ``first + steps``, by least squares."""
    part = Part()
    total = wp.vec2(0.0, 0.0)
    for n in range(steps + 1):
        total += scan.points[around(first + n, scan.count)]
    mean = total / float(steps + 1)
    xx = float(0.0)
    xy = float(0.0)
    yy = float(0.0)
    for n in range(steps + 1):
        away = scan.points[around(first + n, scan.count)] - mean
        xx += away[0] * away[0]
        xy += away[0] * away[1]
        yy += away[1] * away[1]
    angle = 0.5 * wp.atan2(2.0 * xy, xx - yy)
    along = wp.vec2(wp.cos(angle), wp.sin(angle))
    one = wp.dot(scan.points[around(first, scan.count)] - mean, along)
    other = wp.dot(scan.points[around(first + steps, scan.count)] - mean, along)
    part[MEAN_X] = mean[0]
    part[MEAN_Y] = mean[1]
    part[UNIT_X] = along[0]
    part[UNIT_Y] = along[1]
    part[RIGHT] = wp.min(one, other)
    part[LEFT] = wp.max(one, other)
    part[WEIGHT] = xx + yy
    part[OWNER] = NOBODY
    return part


@wp.func
def aside_of(part: Part, k: int, scan: Scan):
    """Returns how far a reading is from the line of a part, m."""
    away = scan.points[around(k, scan.count)] - wp.vec2(part[MEAN_X], part[MEAN_Y])
    return wp.abs(wp.dot(away, normal(wp.vec2(part[UNIT_X], part[UNIT_Y]))))


@wp.func
def fitted_line(first: int, steps: int, scan: Scan):
    """Returns the part with some readings. An outermost one that is off the line of the others is left out."""
    begin = int(first)
    count = int(steps)
    if count >= LEAST:
        if aside_of(line_of(begin + 1, count - 1, scan), begin, scan) > ASIDE:
            begin += 1
            count -= 1
    if count >= LEAST:
        if aside_of(line_of(begin, count - 1, scan), begin + count, scan) > ASIDE:
            count -= 1
    return line_of(begin, count, scan)


@wp.func
def continues(k: int, scan: Scan):
    """Returns whether reading ``k`` and the next one may be of one part."""
    step = scan.points[around(k + 1, scan.count)] - scan.points[k]
    return linked(k, scan) and wp.length(step) < STEP


@wp.func
def find_parts(scan: Scan, parts: wp.array[Part]):
    """Finds the long straight parts of a scan and returns their number.

    Linked readings are cut where one is too far from the line through their ends. What has been cut off is a part of
    its own, or of what follows.
    """
    start = first_gap(scan)
    count = int(0)
    first = int(0)
    for n in range(scan.count):
        if n == scan.count - 1 or not continues(around(start + n, scan.count), scan):
            begin = int(first)
            while n - begin >= LEAST - 1:
                steps = int(n - begin)
                cut = farthest(around(start + begin, scan.count), steps, scan)
                while cut > 0:
                    steps = cut
                    cut = farthest(around(start + begin, scan.count), steps, scan)
                if steps >= LEAST - 1:
                    part = fitted_line(around(start + begin, scan.count), steps, scan)
                    if part[LEFT] - part[RIGHT] > SHORTEST:
                        parts[count] = part
                        count += 1
                begin += steps
            first = n + 1
    return count


@wp.func
def turned_alike(part: Part, track: Track):
    """Returns a part with the direction of the track, not the opposite one."""
    after = Part(part)
    if part[UNIT_X] * track[ALONG_X] + part[UNIT_Y] * track[ALONG_Y] < 0.0:
        after[UNIT_X] = -part[UNIT_X]
        after[UNIT_Y] = -part[UNIT_Y]
        after[RIGHT] = -part[LEFT]
        after[LEFT] = -part[RIGHT]
    return after


@wp.func
def seen_from(track: Track, part: Part):
    """Returns where the mean of a part is from the point of a track: along it, and along its normal."""
    along = wp.vec2(track[ALONG_X], track[ALONG_Y])
    away = wp.vec2(part[MEAN_X] - track[X], part[MEAN_Y] - track[Y])
    return wp.vec2(wp.dot(away, along), wp.dot(away, normal(along)))


@wp.func
def side_of(track: Track, scan: Scan):
    """Returns how far the lidar is from the line of a track, along its normal, m."""
    away = scan.origin - wp.vec2(track[X], track[Y])
    return wp.dot(away, normal(wp.vec2(track[ALONG_X], track[ALONG_Y])))


@wp.func
def plane_of(pose: wp.array[float], imu: wp.array[float]):
    """Returns the plane of the beams: by how much it rises along x and y, and the height of the rover."""
    ahead = -wp.sin(imu[0])
    left = wp.cos(imu[0]) * wp.sin(imu[1])
    cos = wp.cos(imu[2])
    sin = wp.sin(imu[2])
    return wp.vec3(cos * ahead - sin * left, sin * ahead + cos * left, pose[2])


@wp.func
def height_of(part: Part, plane: wp.vec3, scan: Scan):
    """Returns at which height the beams meet a part, m, above that of the lidar on the rover."""
    return plane[2] + plane[0] * (part[MEAN_X] - scan.origin[0]) + plane[1] * (part[MEAN_Y] - scan.origin[1])


@wp.func
def cost(track: Track, given: Part, gate: float):
    """Returns the distance of a track from a part (m), ``FAR`` if they cannot belong together."""
    part = turned_alike(given, track)
    if wp.abs(part[UNIT_X] * track[ALONG_Y] - part[UNIT_Y] * track[ALONG_X]) > PARALLEL:
        return FAR
    place = seen_from(track, part)
    gap = wp.max(place[0] + part[RIGHT] - track[HIGH], track[LOW] - place[0] - part[LEFT])
    return wp.where(wp.abs(place[1]) < gate and gap < APART, wp.abs(place[1]) + 0.1 * wp.max(gap, 0.0), FAR)


@wp.func
def predicted(track: Track, dt: float):
    """Returns a track after an interval."""
    after = Track(track)
    aside = normal(wp.vec2(track[ALONG_X], track[ALONG_Y]))
    after[X] = track[X] + dt * track[SPEED] * aside[0]
    after[Y] = track[Y] + dt * track[SPEED] * aside[1]
    kept = 1.0 - wp.min(dt / FORGET, 1.0)
    after[WAY] = kept * track[WAY] + dt * track[SPEED]
    after[RISE] = kept * track[RISE]
    noise = ACCELERATION * ACCELERATION * dt * dt
    after[VARIANCE] = track[VARIANCE] + 2.0 * dt * track[COVARIANCE] + dt * dt * track[SPREAD] + 0.25 * noise * dt * dt
    after[COVARIANCE] = track[COVARIANCE] + dt * track[SPREAD] + 0.5 * noise * dt
    after[SPREAD] = track[SPREAD] + noise
    after[TURN] = track[TURN] + WANDERS * WANDERS * dt
    return after


@wp.func
def assign(states: wp.array[Track], parts: wp.array[Part], count: int, scan: Scan, seen: wp.array[int]):
    """Gives parts to tracks that are each other's nearest; ``seen`` are the parts of the tracks, or -1."""
    for p in range(count):
        part = parts[p]
        if part[OWNER] < 0.0:
            part[COST] = FAR
            for t in range(states.shape[0]):
                track = states[t]
                if track[EXISTS] > 0.0 and seen[t] < 0:
                    value = cost(track, part, wp.min(NEAR_GATE + WIDE * wp.sqrt(track[VARIANCE]), GATE))
                    if value < part[COST]:
                        part[COST] = value
                        part[OWNER] = float(t)
            parts[p] = part
    for p in range(count):
        t = int(parts[p][OWNER])
        if t >= 0:
            if seen[t] < 0:
                seen[t] = p
            elif parts[p][COST] < parts[seen[t]][COST]:
                seen[t] = p
    for p in range(count):
        t = int(parts[p][OWNER])
        if t >= 0:
            if seen[t] != p:
                part = parts[p]
                part[OWNER] = NOBODY
                parts[p] = part


@wp.func
def track_of(part: Part, plane: wp.vec3, scan: Scan):
    """Returns the new track of a part."""
    track = Track()
    track[EXISTS] = 1.0
    track[X] = part[MEAN_X]
    track[Y] = part[MEAN_Y]
    track[ALONG_X] = part[UNIT_X]
    track[ALONG_Y] = part[UNIT_Y]
    track[LOW] = part[RIGHT]
    track[HIGH] = part[LEFT]
    track[VARIANCE] = NOISE * NOISE
    track[SPREAD] = FASTEST * FASTEST
    track[TURN] = BENT * BENT + NOISE * NOISE / part[WEIGHT]
    track[MISFIT] = 1.0
    track[SCANS] = 1.0
    track[SIDE] = side_of(track, scan)
    track[HEIGHT] = height_of(part, plane, scan)
    return track


@wp.func
def turned_towards(track: Track, part: Part):
    """Returns a track that turns to the direction of a part, about its point."""
    after = Track(track)
    noise = BENT * BENT + NOISE * NOISE / part[WEIGHT]
    expected = track[TURN] + noise
    gain = track[TURN] / expected
    off = track[ALONG_X] * part[UNIT_Y] - track[ALONG_Y] * part[UNIT_X]
    angle = gain * off
    along = wp.normalize(wp.vec2(track[ALONG_X] - angle * track[ALONG_Y], track[ALONG_Y] + angle * track[ALONG_X]))
    after[ALONG_X] = along[0]
    after[ALONG_Y] = along[1]
    after[TURN] = (1.0 - gain) * track[TURN]
    after[MISFIT] = track[MISFIT] + RECENT * wp.min(off * off / expected, 10.0)
    return after


@wp.func
def followed(track: Track, given: Part, plane: wp.vec3, scan: Scan):
    """Returns a track after it has been seen as a part. Its point becomes the one nearest to the part's mean."""
    part = turned_alike(given, track)
    place = seen_from(track, part)
    side = side_of(track, scan)
    a = track[VARIANCE]
    if side * track[SIDE] < 0.0:
        # The other side of the wall.
        a += THICK * THICK
    expected = a + NOISE * NOISE + track[TURN] * place[0] * place[0]
    if place[1] * place[1] > JUMP * JUMP * expected:
        return track_of(part, plane, scan)
    after = Track(track)
    gain = a / expected
    rate = track[COVARIANCE] / expected
    aside = normal(wp.vec2(track[ALONG_X], track[ALONG_Y]))
    after[X] = track[X] + place[0] * track[ALONG_X] + gain * place[1] * aside[0]
    after[Y] = track[Y] + place[0] * track[ALONG_Y] + gain * place[1] * aside[1]
    after[LOW] = wp.min(track[LOW] - place[0], part[RIGHT])
    after[HIGH] = wp.max(track[HIGH] - place[0], part[LEFT])
    after[SPEED] = track[SPEED] + rate * place[1]
    after[WAY] = track[WAY] + gain * place[1]
    after[VARIANCE] = (1.0 - gain) * a
    after[COVARIANCE] = (1.0 - gain) * track[COVARIANCE]
    after[SPREAD] = track[SPREAD] - rate * track[COVARIANCE]
    after[MISFIT] = track[MISFIT] + RECENT * (wp.min(place[1] * place[1] / expected, 10.0) - track[MISFIT])
    after[SCANS] = track[SCANS] + 1.0
    after[UNSEEN] = 0.0
    after[SIDE] = side
    after[HEIGHT] = height_of(part, plane, scan)
    after[RISE] = track[RISE] + after[HEIGHT] - track[HEIGHT]
    return turned_towards(after, part)


@wp.func
def passing(track: Track, before: float, k: int, scan: Scan):
    """Returns where a beam crosses the line of a track and goes on, from the point of the track, or ``FAR``.

    The lidar is ``before`` (m) the track, along its normal.
    """
    along = wp.vec2(track[ALONG_X], track[ALONG_Y])
    away = scan.points[k] - wp.vec2(track[X], track[Y])
    beyond = wp.dot(away, normal(along))
    if scan.ranges[k] < 0.0 or before * beyond > 0.0 or wp.min(wp.abs(before) - INLINE, wp.abs(beyond) - BEYOND) < 0.0:
        return FAR
    share = beyond / (beyond - before)
    return wp.dot(away + share * (scan.origin - scan.points[k]), along)


@wp.func
def trimmed(track: Track, part: Part, scan: Scan):
    """Returns a track that has been seen as a part, and ends where beams beside the part pass."""
    after = Track(track)
    alike = turned_alike(part, track)
    place = seen_from(track, alike)
    right = place[0] + alike[RIGHT]
    left = place[0] + alike[LEFT]
    before = side_of(track, scan)
    for k in range(scan.count):
        where = passing(track, before, k, scan)
        if where < right:
            after[LOW] = wp.max(after[LOW], where)
        elif where > left:
            after[HIGH] = wp.min(after[HIGH], where)
    return after


@wp.func
def missed(track: Track, scan: Scan, dt: float):
    """Returns a track that has not been seen. It ends at once if it rests, or if beams pass where it should be."""
    after = Track(track)
    after[UNSEEN] = track[UNSEEN] + dt
    if track[MOVES] == 0.0:
        return Track()
    passed = int(0)
    before = side_of(track, scan)
    for k in range(scan.count):
        where = passing(track, before, k, scan)
        if where > track[LOW] + INNER and where < track[HIGH] - INNER:
            passed += 1
    ends = passed >= PASSING or after[UNSEEN] > HIDDEN
    after[EXISTS] = wp.where(ends, 0.0, 1.0)
    return after


@wp.func
def with_motion(track: Track, plane: wp.vec3):
    """Returns a track with whether it moves."""
    after = Track(track)
    speed = wp.abs(track[SPEED])
    way = wp.abs(track[WAY]) - STEEP * wp.abs(track[RISE])
    if track[MOVES] > 0.0:
        after[MOVES] = wp.where(speed > STILL and way > 0.0 and track[MISFIT] < WRONG, 1.0, 0.0)
    else:
        level = wp.length(wp.vec2(plane[0], plane[1])) < LEVEL
        begins = level and track[SCANS] >= SURE and speed > wp.max(SLOWEST, CERTAIN * wp.sqrt(track[SPREAD]))
        far = way > LEAST_WAY and track[WAY] * track[SPEED] > 0.0
        after[MOVES] = wp.where(begins and far and track[MISFIT] < CONSISTENT, 1.0, 0.0)
    return after


@wp.func
def is_known(track: Track):
    """Returns whether a track moves and its place and velocity are known well enough."""
    return track[MOVES] > 0.0 and track[VARIANCE] < UNKNOWN * UNKNOWN and wp.abs(track[SPEED]) < TOP


@wp.func
def is_behind(track: Track, other: Track, scan: Scan):
    """Returns whether a track is hidden by all of another one that rests, or has moved into that one."""
    if other[EXISTS] == 0.0 or other[MOVES] + other[UNSEEN] > 0.0 or other[SCANS] < SURE:
        return False
    along = wp.vec2(other[ALONG_X], other[ALONG_Y])
    mine = wp.vec2(track[ALONG_X], track[ALONG_Y])
    away = wp.vec2(track[X] - other[X], track[Y] - other[Y])
    one = wp.dot(away + track[LOW] * mine, along)
    two = wp.dot(away + track[HIGH] * mine, along)
    covered = wp.min(one, two) > other[LOW] - APART and wp.max(one, two) < other[HIGH] + APART
    side = wp.dot(away, normal(along)) * wp.sign(side_of(other, scan))
    parallel = wp.abs(wp.dot(mine, normal(along))) < PARALLEL
    return covered and parallel and side < THICK


@wp.func
def end_hidden(states: wp.array[Track], scan: Scan):
    """Ends tracks that move and have gone behind or into what rests."""
    for t in range(states.shape[0]):
        if states[t][UNSEEN] > 0.0 and states[t][MOVES] > 0.0:
            gone = bool(False)
            for other in range(states.shape[0]):
                gone = gone or is_behind(states[t], states[other], scan)
            if gone:
                states[t] = Track()


@wp.func
def start_tracks(states: wp.array[Track], parts: wp.array[Part], count: int, plane: wp.vec3, scan: Scan):
    """Starts tracks of the parts that have none, where there is room, and are not on a track that has been seen."""
    for p in range(count):
        part = parts[p]
        if part[OWNER] < 0.0:
            room = int(-1)
            alone = bool(True)
            for t in range(states.shape[0]):
                track = states[t]
                if track[EXISTS] == 0.0:
                    room = wp.where(room < 0, t, room)
                elif cost(track, part, JOINT) < FAR:
                    alone = False
            if alone and room >= 0:
                states[room] = track_of(part, plane, scan)


@wp.kernel
def follow_walls(
    scans: Scans,
    befores: wp.array2d[Track],
    parts: wp.array2d[Part],
    seens: wp.array2d[int],
    states: wp.array2d[Track],
    moves: wp.array2d[wp.bool],
):
    """Adds a scan to the tracks of each row that is ``due``; thread ``i``.

    Args:
        scans: scans of all rows.
        befores: tracks before, ``[N, TRACKS]``.
        parts: memory for the straight parts, ``[N, P]``.
        seens: memory for the parts of the tracks, ``[N, TRACKS]``.
        states: tracks, the result.
        moves: which tracks move, the result.
    """
    i = wp.tid()
    if not scans.due[i]:
        for t in range(states.shape[1]):
            states[i, t] = befores[i, t]
        return
    scan = scan_of(scans, i)
    plane = plane_of(scans.poses[i], scans.imus[i])
    dt = scans.dt
    count = find_parts(scan, parts[i])
    for t in range(states.shape[1]):
        states[i, t] = predicted(befores[i, t], dt)
        seens[i, t] = -1
    for _ in range(2):
        assign(states[i], parts[i], count, scan, seens[i])
    for t in range(states.shape[1]):
        track = states[i, t]
        if track[EXISTS] > 0.0:
            if seens[i, t] >= 0:
                part = parts[i, seens[i, t]]
                track = with_motion(trimmed(followed(track, part, plane, scan), part, scan), plane)
            else:
                track = missed(track, scan, dt)
        if track[EXISTS] == 0.0:
            track = Track()
        states[i, t] = track
    end_hidden(states[i], scan)
    start_tracks(states[i], parts[i], count, plane, scan)
    for t in range(states.shape[1]):
        moves[i, t] = is_known(states[i, t])
