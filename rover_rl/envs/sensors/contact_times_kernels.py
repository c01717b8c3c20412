"""Warp kernel of :mod:`~rover_rl.envs.sensors.contact_times`: drives of each rover among points and moving discs."""

from __future__ import annotations

from rover_rl.native.warp import wp

FAR = wp.constant(1.0e6)  # square of a distance where there are no points, m^2
ROUNDING = wp.constant(1.0e-4)  # more than what a way of a step differs by, computed in two ways, m


@wp.struct
class Scene:
    """What is around the rovers, in their base frames: readings, ``[N, P]``, and movers, ``[N, M, 5]``."""

    ranges: wp.array2d[float]  # m
    farthest: float  # range from which on there is no obstacle, m
    directions: wp.array[wp.vec2]  # of the readings, [P]
    scan_poses: wp.array2d[float]  # where they were taken: ahead, left (m), and last the turn (rad), [N, 6]
    movers: wp.array3d[float]  # x, y (m), velocity along x and y (m/s), and radius (m), 0 after the last one
    slack: float  # distance from a mover up to which readings belong to it, m
    points: wp.array2d[wp.vec2]  # scratch: the ends of the readings that matter, m


@wp.struct
class Limits:
    """Numbers of a robot, from a row of the table of ``contact_times``."""

    front: float  # x of the front disc that covers the body, m; minus that of the rear one
    middle: float  # 1 if there is a third disc at the origin, else 0
    radius: float  # of the discs, m
    speed: float  # largest, m/s
    acceleration: float  # m/s^2
    yaw_rate: float  # largest of the body, rad/s
    yaw_acceleration: float  # of the body, rad/s^2
    turning: float  # least radius of a turn, m
    gain: float  # yaw rate of the body over that of the wheels


@wp.struct
class Drives:
    """Drives that are tried."""

    speeds: int  # number of speeds, from full speed backward to full speed ahead
    turns: int  # number of yaw rates, from right to left
    step: float  # time step, s
    steps: int  # number of steps
    longest: float  # time without a contact, s


@wp.func
def limits_of(robots: wp.array2d[float], k: int) -> Limits:
    limits = Limits()
    limits.front = robots[k, 0]
    limits.middle = robots[k, 1]
    limits.radius = robots[k, 2]
    limits.speed = robots[k, 3]
    limits.acceleration = robots[k, 4]
    limits.yaw_rate = robots[k, 5]
    limits.yaw_acceleration = robots[k, 6]
    limits.turning = robots[k, 7]
    limits.gain = robots[k, 8]
    return limits


@wp.func
def is_of_mover(scene: Scene, row: int, point: wp.vec2) -> bool:
    """Whether a reading belongs to what moves."""
    for m in range(scene.movers.shape[1]):
        radius = scene.movers[row, m, 4]
        if radius <= 0.0:
            break
        if wp.length(point - wp.vec2(scene.movers[row, m, 0], scene.movers[row, m, 1])) < radius + scene.slack:
            return True
    return False


@wp.func
def gather(scene: Scene, row: int, mount: wp.vec2, reach: float) -> int:
    """Writes the ends of the readings within reach that do not move, and returns their number."""
    count = int(0)
    begin = wp.vec2(scene.scan_poses[row, 0], scene.scan_poses[row, 1])
    cos = wp.cos(scene.scan_poses[row, 5])
    sin = wp.sin(scene.scan_poses[row, 5])
    for k in range(scene.directions.shape[0]):
        distance = scene.ranges[row, k]
        then = mount + distance * scene.directions[k]
        point = begin + wp.vec2(cos * then[0] - sin * then[1], sin * then[0] + cos * then[1])
        if distance < scene.farthest and wp.length(point) < reach:
            if not is_of_mover(scene, row, point):
                scene.points[row, count] = point
                count += 1
    return count


@wp.func
def meets_mover(scene: Scene, row: int, center: wp.vec2, radius: float, time: float) -> bool:
    """Whether a disc touches a mover that has kept its velocity for some time."""
    for m in range(scene.movers.shape[1]):
        size = scene.movers[row, m, 4]
        if size <= 0.0:
            break
        x = scene.movers[row, m, 0] + time * scene.movers[row, m, 2] - center[0]
        y = scene.movers[row, m, 1] + time * scene.movers[row, m, 3] - center[1]
        if x * x + y * y < (radius + size) * (radius + size):
            return True
    return False


@wp.func
def room_of(scene: Scene, row: int, count: int, center: wp.vec2, radius: float) -> float:
    """Distance that a disc can move in any direction until it touches a point, m; less than 0 if it touches one."""
    # Two chains of minima, which a processor follows side by side.
    points = scene.points[row]
    nearest = float(FAR)
    other = float(FAR)
    for k in range(0, count, 2):
        nearest = wp.min(nearest, wp.length_sq(points[k] - center))
        other = wp.min(other, wp.length_sq(points[wp.min(k + 1, count - 1)] - center))
    nearest = wp.min(nearest, other)
    return wp.where(nearest < radius * radius, -1.0, wp.sqrt(nearest) - radius)


@wp.func
def turned(direction: wp.vec2, by: wp.vec2) -> wp.vec2:
    """Direction turned by an angle, given by its cosine and sine."""
    return wp.vec2(direction[0] * by[0] - direction[1] * by[1], direction[0] * by[1] + direction[1] * by[0])


@wp.func
def time_of(
    scene: Scene, row: int, count: int, speed: float, yaw_rate: float, start: wp.vec2, limits: Limits, drives: Drives
) -> float:
    """Time until a rover that steers for a speed and a yaw rate touches something, s.

    Points are looked at again only once a disc may have moved as far as it had room.
    """
    dt = drives.step
    v = start[0]
    w = start[1]
    place = wp.vec2(0.0, 0.0)
    ahead = wp.vec2(1.0, 0.0)
    half = wp.vec2(1.0, 0.0)  # turn of half a step, as cosine and sine
    reach = limits.front + limits.radius + ROUNDING
    rooms = wp.vec3(0.0, 0.0, 0.0)  # of the discs ahead, behind and in the middle, m
    for step in range(drives.steps):
        v += wp.clamp(speed - v, -limits.acceleration * dt, limits.acceleration * dt)
        change = wp.clamp(yaw_rate - w, -limits.yaw_acceleration * dt, limits.yaw_acceleration * dt)
        w += change
        if step == 0 or change != 0.0:
            half = wp.vec2(wp.cos(0.5 * w * dt), wp.sin(0.5 * w * dt))
        # Along the heading in the middle of the step.
        ahead = turned(ahead, half)
        place += v * dt * ahead
        ahead = turned(ahead, half)
        time = dt * float(step + 1)
        moved = (wp.abs(v) + limits.front * wp.abs(w)) * dt + ROUNDING
        near = meets_mover(scene, row, place, reach, time)
        for k in range(3):
            # The disc ahead is the only one of a round robot.
            if k == 0 or (k == 1 and limits.front > 0.0) or (k == 2 and limits.middle > 0.0):
                side = wp.where(k == 2, 0.0, limits.front * (1.0 - 2.0 * float(k)))
                center = place + side * ahead
                rooms[k] = rooms[k] - moved
                if rooms[k] < 0.0:
                    rooms[k] = room_of(scene, row, count, center, limits.radius)
                if rooms[k] < 0.0 or (near and meets_mover(scene, row, center, limits.radius, time)):
                    return time
    return drives.longest


@wp.kernel
def measure(
    scene: Scene,
    drives: Drives,
    robots: wp.array2d[float],
    index: wp.array[wp.int64],
    mounts: wp.array[wp.vec2],
    velocities: wp.array2d[float],
    rows: wp.array[wp.bool],
    times: wp.array2d[float],
    first: int,
):
    """Writes the times to contact of a row: speed by speed, all yaw rates.

    ``velocities`` are speed (m/s) and yaw rate (rad/s) of the wheels. ``rows`` are those that are written.
    """
    row = first + wp.tid()
    if not rows[row]:
        return
    robot = int(index[row])
    limits = limits_of(robots, robot)
    start = wp.vec2(velocities[row, 0], velocities[row, 1] * limits.gain)
    fastest = wp.max(limits.speed, wp.abs(start[0]))
    way = fastest * drives.step * float(drives.steps)
    count = gather(scene, row, mounts[robot], way + limits.front + limits.radius)
    for k in range(drives.speeds * drives.turns):
        speed = limits.speed * (2.0 * float(k / drives.turns) / float(drives.speeds - 1) - 1.0)
        yaw_rate = limits.yaw_rate * (2.0 * float(k % drives.turns) / float(drives.turns - 1) - 1.0)
        if limits.turning > 0.0:
            yaw_rate = wp.clamp(yaw_rate, -wp.abs(speed) / limits.turning, wp.abs(speed) / limits.turning)
        times[row, k] = time_of(scene, row, count, speed, yaw_rate, start, limits, drives)
