"""Warp kernels of :class:`~rover_rl.envs.sensors.past_scans.PastScans`: keep scans, and show them from elsewhere.

``ends [N, scans]`` are the ends of beams in the world (m). A frame is x and y of the lidar (m) and its heading (rad).
"""

from __future__ import annotations

from rover_rl.native.warp import wp

FAR = wp.constant(1.0e6)  # length of a beam without a return, m
TURN = wp.constant(6.283185307179586)  # a full turn, rad


@wp.func
def turned(angle: float, point: wp.vec2):
    cos, sin = wp.cos(angle), wp.sin(angle)
    return wp.vec2(cos * point[0] - sin * point[1], sin * point[0] + cos * point[1])


@wp.kernel
def keep(
    due: wp.array[bool],
    renewed: wp.array[bool],
    lidar: wp.array2d[float],
    no_return: float,
    directions: wp.array[wp.vec2],
    frames: wp.array[wp.vec3],
    latest: wp.array[int],
    ends: wp.array3d[wp.vec2],
):
    """Writes the scans of the rows that are due to the place ``latest``, and to all places of a new episode."""
    row = wp.tid()
    if due[row]:
        frame = frames[row]
        for point in range(lidar.shape[1]):
            reach = wp.where(lidar[row, point] < no_return, lidar[row, point], FAR)
            end = wp.vec2(frame[0], frame[1]) + turned(frame[2], reach * directions[point])
            if renewed[row]:
                for place in range(ends.shape[1]):
                    ends[row, place, point] = end
            else:
                ends[row, latest[row], point] = end


@wp.kernel
def show(
    due: wp.array[bool],
    frames: wp.array[wp.vec3],
    latest: wp.array[int],
    apart: int,
    ends: wp.array3d[wp.vec2],
    ranges: wp.array3d[float],
):
    """Shortens ``ranges [N, count, directions]`` to those of the kept scans, seen from ``frames``.

    A reading counts in the two directions beside it, so that what has come nearer has no gaps.
    """
    row, scan = wp.tid()
    if due[row]:
        frame, count = frames[row], ranges.shape[2]
        place = (latest[row] + ends.shape[1] - scan * apart) % ends.shape[1]
        for point in range(ends.shape[2]):
            end = turned(-frame[2], ends[row, place, point] - wp.vec2(frame[0], frame[1]))
            distance = wp.length(end)
            share = wp.atan2(end[1], end[0]) * float(count) / TURN
            before = (int(wp.floor(share)) + count) % count
            after = (before + 1) % count
            ranges[row, scan, before] = wp.min(ranges[row, scan, before], distance)
            ranges[row, scan, after] = wp.min(ranges[row, scan, after], distance)
