"""The plane of a lidar scan, and how far the lidar sees in it, in the frames of ``lidar.py``."""

from __future__ import annotations

from rover_rl.native.warp import wp

SECTORS = 32
"""Sectors of a scan for which the farthest visible range is tracked."""
SECTOR_SLACK = 0.01
"""Tolerance of angles in the occlusion test, in sectors."""
RANGE_SLACK = 1e-3
"""Margin (m) of visible ranges for rounding errors: culling never changes a range, so that their order is free."""


@wp.struct
class Scan:
    """The scan of a rover, or the share of one of the threads that scan for it, its lanes.

    ``origin`` is the lidar in the world frame; ``ahead``, ``left`` and ``normal`` are the axes of the base frame in the
    world frame. Relative to the lidar, the plane is ``z = rise_x x + rise_y y``; its point above (x, y) lies
    ``ahead_from_xy . (x, y)`` ahead of the lidar and ``left_from_xy . (x, y)`` to its left. ``range`` is the maximum
    range of the lidar. A beam that ends nearer than ``tie`` times the distance of a segment is not compared with it.
    """

    # Unit directions of the beams (ahead, left), ranges and bounds of how far each sector sees, and the rover's row.
    beams: wp.array[wp.vec2]
    ranges: wp.array2d[float]
    visible: wp.array2d[float]
    row: int
    origin: wp.vec3
    normal: wp.vec3
    ahead: wp.vec3
    left: wp.vec3
    rise_x: float
    rise_y: float
    ahead_from_xy: wp.vec2
    left_from_xy: wp.vec2
    range: float
    lane: int
    lanes: int
    tie: float


@wp.func
def start_scan(position: wp.vec3, orientation: wp.quat, lidar_position: wp.vec3, max_range: float) -> Scan:
    """Plane of the scan of a lidar mounted at ``lidar_position`` in the base frame.

    From ``n . p = 0``: ``rise_x = -n_x / n_z``, ``rise_y = -n_y / n_z``. With the axis a = (a_x, a_y, a_z) of the base
    frame, ``a . (x, y, rise_x x + rise_y y) = (a_x + a_z rise_x) x + (a_y + a_z rise_y) y``.
    """
    scan = Scan()
    rotation = wp.quat_to_matrix(orientation)
    scan.origin = position + rotation * lidar_position
    scan.ahead = wp.vec3(rotation[0, 0], rotation[1, 0], rotation[2, 0])
    scan.left = wp.vec3(rotation[0, 1], rotation[1, 1], rotation[2, 1])
    scan.normal = wp.vec3(rotation[0, 2], rotation[1, 2], rotation[2, 2])
    up = scan.normal[2]
    # A vertical plane has no slopes: use one that is tilted by a milliradian.
    up = wp.where(wp.abs(up) < 1.0e-3, wp.where(up < 0.0, -1.0e-3, 1.0e-3), up)
    scan.rise_x = -scan.normal[0] / up
    scan.rise_y = -scan.normal[1] / up
    scan.ahead_from_xy = wp.vec2(
        scan.ahead[0] + scan.ahead[2] * scan.rise_x, scan.ahead[1] + scan.ahead[2] * scan.rise_y
    )
    scan.left_from_xy = wp.vec2(scan.left[0] + scan.left[2] * scan.rise_x, scan.left[1] + scan.left[2] * scan.rise_y)
    scan.range = max_range
    return scan


@wp.func
def stretch_of(scan: Scan) -> float:
    """Factor that bounds a length in the scan plane by its length seen from above."""
    return 1.0 / wp.max(wp.abs(scan.normal[2]), 1.0e-3)


@wp.func
def angle_in_turns(x: float, y: float) -> float:
    """Angle of (x, y) in turns, from -0.5 to 0.5, with an error below 2e-6.

    Polynomial approximation of arctan on [0, 1] (M. Abramowitz and I. Stegun, "Handbook of Mathematical Functions",
    4.4.49), extended to all octants by symmetry.
    """
    smaller = wp.min(wp.abs(x), wp.abs(y))
    larger = wp.max(wp.max(wp.abs(x), wp.abs(y)), 1.0e-12)
    a = smaller / larger
    s = a * a
    angle = 0.0208351
    angle = angle * s - 0.0851330
    angle = angle * s + 0.1801410
    angle = angle * s - 0.3302995
    angle = (angle * s + 0.9998660) * a
    if wp.abs(y) > wp.abs(x):
        angle = 1.57079633 - angle
    if x < 0.0:
        angle = 3.14159265 - angle
    return wp.where(y < 0.0, -angle, angle) * 0.15915494


@wp.func
def update_visibility(scan: Scan) -> float:
    """Bounds how far each sector of the scan sees, and returns the bound of the farthest of all, m.

    A lane updates every ``lanes``-th sector. Bounds may be out of date: ranges only shrink, so that an old bound holds.
    """
    count = scan.beams.shape[0]
    for sector in range(scan.lane, SECTORS, scan.lanes):
        sector_range = float(0.0)
        # Beams whose directions are in the sector.
        first = (sector * count + SECTORS - 1) // SECTORS
        last = ((sector + 1) * count + SECTORS - 1) // SECTORS - 1
        # Groups of four shorten the chain of dependent maxima.
        for beam in range(first, last + 1, 4):
            one = wp.max(scan.ranges[scan.row, beam], scan.ranges[scan.row, wp.min(beam + 1, last)])
            two = wp.max(scan.ranges[scan.row, wp.min(beam + 2, last)], scan.ranges[scan.row, wp.min(beam + 3, last)])
            sector_range = wp.max(sector_range, wp.max(one, two))
        scan.visible[scan.row, sector] = wp.min(sector_range + RANGE_SLACK, scan.range)
    farthest = float(0.0)
    for sector in range(SECTORS):
        farthest = wp.max(farthest, scan.visible[scan.row, sector])
    return farthest


@wp.func
def is_occluded(scan: Scan, x: float, y: float, radius: float, distance: float) -> bool:
    """Conservative occlusion test of a disk in the scan scan.

    The disk is occluded if every sector that it overlaps sees less far than to it. Its half-width in angle is
    ``asin(radius / d) <= (radius / d) (pi / 2)``, or ``0.25 radius / d`` turns. Its center is at x and y relative to
    the lidar, and ``distance`` is a lower bound of that of its points to it, m.
    """
    ahead = scan.ahead_from_xy[0] * x + scan.ahead_from_xy[1] * y
    left = scan.left_from_xy[0] * x + scan.left_from_xy[1] * y
    middle = angle_in_turns(ahead, left) * float(SECTORS)
    share = radius / wp.sqrt(ahead * ahead + left * left)
    if share >= 1.0:
        # The lidar is inside of the disk, which overlaps all sectors.
        return False
    width = share * 0.25 * float(SECTORS) + SECTOR_SLACK
    for k in range(int(wp.floor(middle - width)), int(wp.floor(middle + width)) + 1):
        sector = (k + 2 * SECTORS) % SECTORS
        if scan.visible[scan.row, sector] > distance:
            return False
    return True
