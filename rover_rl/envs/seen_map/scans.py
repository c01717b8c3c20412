"""What a lidar scan tells about the ground around rovers.

A map is a window of ``SIZE x SIZE`` cells around the rover, which moves with it cell by cell. Cell (X, Y) of the world
covers ``CELL * [X, X + 1)`` by ``CELL * [Y, Y + 1)``, m. Cells are as wide as a gap's tolerance. Occupied ones
therefore also hold the box in which the obstacle has been seen.

For a robot that needs wider worlds than Rover Zero, all lengths are that much larger: the map has the unit
:func:`map_unit` in place of the meter.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from rover_rl.envs.config import LidarConfig
from rover_rl.envs.sensors.standard import WHOLE
from rover_rl.robots import Robot
from rover_rl.rotations import euler_to_matrix, wrap_angle
from rover_rl.sims.free_space.fitting import passage_scale
from rover_rl.sims.rays import seen
from rover_rl.sims.rover_state import beam_angles

SIZE, HALF = 128, 64  # numbers of cells along a side of the window, a power of two, and on each side of the rover's
CELL = 0.15  # side length of a cell, m
PARTS = 16  # number of parts along a side of a cell, in which the ends of beams are told apart
UNSEEN = -1.0e9  # height of a cell whose ground has not been seen, m

# Evidence of a cell: on rough ground in which a beam has ended, at an obstacle or at a slope that can be climbed;
# from which on it counts as occupied; that a reading adds to the cell at its end; the largest from readings, of which
# each beam that passes takes 1 away; and that of a cell that is too steep or cannot be reached, which beams leave.
SUSPECTED, OCCUPIED, HIT, MOST, CLOSED = 1, 2, 4, 12, 15
# Level of a cell far from obstacles, and highest one near a suspected one, which a route crosses if a detour is three
# times as long. Cells at obstacles have level 0, and Limits tells the others.
OPEN, DOUBTFUL = 4, 2
# Distances of a rover's side from obstacles below which it does not fit, hardly fits, and should be slow, m.
MARGINS = (0.01, 0.075, 0.225)

# Number of cells along an axis up to which beams count: 9 m. All of them are in the window, if the lidar is at most 3
# cells, FARTHEST_MOUNT (m), from the rover's center along each axis.
REACH, FARTHEST_MOUNT = 60, 0.45
NO_GAP = 4.0  # distance between the ends of neighboring beams up to which nothing fits between them, cells: 0.6 m
LOWEST = -4.0 / 3.0  # height of the end of a beam above the lidar below which it is on the ground, cells: -0.2 m
# Tilt of the rover above which the ground is not level, rad: 3 degrees. On level ground, it tilts by 0.01 at most.
ROUGH_TILT = 0.05
MAX_TILT = 0.42  # slope above which ground is too steep, rad: 24 degrees. Tires of usual friction slide at 26.6.
# Number of cells along an axis up to which the ends of beams tell heights: 3 m. An error of 1 degree in the tilt
# changes the height there by 5 cm.
FARTHEST_HEIGHT = 20
STRETCH = 4  # number of cells between two heights that are compared, at most: 0.6 m
AHEAD = 3.0  # distance from the rover at which a cell is closed, in cells: 0.45 m
WAY = 0.5  # distance up to which a rover is still around a place, m
# Time in which a rover makes half a meter of way, if it can get on, s: one that turns in place, which takes 3 s for a
# half turn, and one that turns around by driving back and forth.
PATIENCE, MANEUVERS = 8.0, 20.0

# Sizes of the parts of a rover's state: the cell in the middle of the window, whether the ground is rough, the place
# around which the rover is and its number of scans there, and the first corner of its route. Zeros before an episode.
STATE = (2, 1, 2, 1, 2)
# How many of the numbers of reading_of come before those of each reading.
NUMBERS = 5


class Scan(NamedTuple):
    """What scans tell. x and y are in cells of the world.

    Attributes:
        center: cells in the middle of the windows, ``[N, 2]``.
        cleared: whether the map is cleared first, bool ``[N]``: the episode begins, or the ground turns out to be
            rough, so that what the map holds may be gentle slopes.
        rough: whether the ground is rough, bool ``[N]``.
        origin: x and y of the lidar, ``[N, 2]``.
        beams: vectors from the lidar to the ends of the beams, ``[N, P, 3]``, in cells.
        hits: whether the end of a beam is at an obstacle, bool ``[N, P]``.
        doubts: whether it is at a suspected one, bool ``[N, P]``.
        ground: x, y and z (m) of points on the ground, ``[N, P + 1, 3]``. z is ``UNSEEN`` at points that do not count.
        closed: x and y of two places that the rover cannot get to, ``[N, 2, 2]``: uphill, and ahead on its route.
        closes: which of these places count, bool ``[N, 2]``.
    """

    center: Tensor
    cleared: Tensor
    rough: Tensor
    origin: Tensor
    beams: Tensor
    hits: Tensor
    doubts: Tensor
    ground: Tensor
    closed: Tensor
    closes: Tensor


def read_scans(
    state: Tensor,
    lidar: Tensor,
    pose: Tensor,
    imu: Tensor,
    taken: tuple[Tensor, Tensor],
    readings: Tensor,
    directions: Tensor,
    mask: Tensor | None = None,
) -> tuple[Scan, Tensor]:
    """Returns what scans tell, and the next ``STATE`` up to the corner of the route, which is not known yet.

    Args:
        state: state before, ``[N, 8]``.
        lidar, pose, imu: entries of the observation in units of the map, ``[N, n]``.
        taken: ``pose`` and ``imu`` at which the scan was taken.
        readings: :func:`reading_of` the robots, ``[N, NUMBERS + P]``.
        directions: :func:`reading_directions`, ``[P, 2]``.
        mask: entry ``lidar_mask``. ``None``: beams cover what is in view.
    """
    mount, no_return, patience = readings[:, :NUMBERS].split((3, 1, 1), -1)
    is_seen = readings[:, NUMBERS:] > 0
    if mask is not None:
        is_seen = (mask > WHOLE) & is_seen
    _, was_rough, place, waits, corner = state.split(STATE, -1)
    (at, attitude), xy, up = taken, pose[:, :2], _axes(imu)[..., 2]
    tilted = _axes(attitude)
    rough = (was_rough > 0) | (up[:, 2:] < math.cos(ROUGH_TILT))
    center = (xy / CELL).floor()
    cos, sin = attitude[:, 2:].cos(), attitude[:, 2:].sin()
    offset = mount[:, :1] * torch.cat((cos, sin), -1) + mount[:, 1:2] * torch.cat((-sin, cos), -1)
    origin, ahead, left = (at[:, :2] + offset) / CELL, tilted[:, None, :, 0], tilted[:, None, :, 1]
    # A reading outside of the view is a beam without length, which clears no cell.
    directions = directions * is_seen[..., None]
    beams = (lidar / CELL)[..., None] * (directions[..., :1] * ahead + directions[..., 1:] * left)
    # The rover may have moved on since the scan, and the window with it.
    late = ((at != pose) | (attitude != imu)).any(-1, keepdim=True)
    reach = HALF - 1 - (origin - center).abs().amax(-1, keepdim=True)
    size, reach = beams[..., :2].abs().amax(-1), torch.where(late, reach, float(REACH)).clamp(0, REACH)
    beams = torch.where(late, reach / size.maximum(reach).clamp(min=1e-6), 1.0)[..., None] * beams
    returned = (lidar < no_return) & is_seen
    ends = returned & (size < reach)
    hits = ends & (beams[..., 2] > LOWEST) & (_is_steep(beams, tilted[..., 2], mount) | ~rough)
    shown = torch.cat((rough, rough & returned & (size < FARTHEST_HEIGHT)), -1)
    height = at[:, 2:] + (tilted[:, 2] * mount).sum(-1, keepdim=True)
    z = torch.cat((pose[:, 2:], height + CELL * beams[..., 2]), -1)
    points = torch.cat((xy[:, None] / CELL, origin[:, None] + beams[..., :2]), 1)
    ground = torch.cat((points, torch.where(shown, z, UNSEEN)[..., None]), -1)
    leaves = (waits == 0) | ((xy - place).norm(dim=-1, keepdim=True) > WAY)
    place, scans = torch.where(leaves, xy, place), torch.where(leaves, 1.0, waits + 1)
    halts = scans > patience
    # The rover's vertical axis leans downhill.
    ways = torch.stack((-up[:, :2], corner - xy), 1)
    closed = xy[:, None] / CELL + AHEAD * ways / ways.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    closes = torch.cat((up[:, 2:] < math.cos(MAX_TILT), halts), -1)
    cleared = ((waits == 0) | ((was_rough > 0) != rough))[:, 0]
    scan = Scan(center, cleared, rough[:, 0], origin, beams, hits, ends & rough & ~hits, ground, closed, closes)
    return scan, torch.cat((center, rough.to(xy.dtype), place, torch.where(halts, 1.0, scans)), -1)


def _is_steep(beams: Tensor, up: Tensor, mount: Tensor) -> Tensor:
    """Returns whether beams end at an obstacle on rough ground, too, and not at a slope that the rover can climb.

    Some of the ground from below the lidar to the end of the beam is at least as steep as the straight line between
    them. So the end is an obstacle if that line is too steep: on a level rover with the lidar at 0.32 m, within 0.72 m.
    Farther ends are suspected ones.
    """
    rise = beams + (mount[..., 2:] / CELL * up)[:, None]
    return rise[..., 2] > math.tan(MAX_TILT) * rise[..., :2].norm(dim=-1)


def _axes(imu: Tensor) -> Tensor:
    """Returns the axes of the rovers by pitch, roll and yaw. A list of indices would wait for a GPU."""
    pitch, roll, yaw = imu.split(1, -1)
    return euler_to_matrix(torch.cat((roll, pitch, yaw), -1))


def reading_angles(lidar: LidarConfig) -> Tensor:
    """Returns the angles of the readings of a lidar, ``[P]``, rad.

    A reading is the minimum over several beams: its angle is that of their center.
    """
    share = lidar.beams / lidar.points
    return (torch.arange(lidar.points) * share + (share - 1) / 2) * (2 * math.pi / lidar.beams)


def reading_directions(lidar: LidarConfig) -> Tensor:
    """Returns the directions of the readings of a lidar in the plane, ``[P, 2]``."""
    angles = reading_angles(lidar)
    return torch.stack((angles.cos(), angles.sin()), -1)


def limits_of(robot: Robot) -> tuple[int, int, int, int, int]:
    """Returns by which distances from obstacles the cells have levels, for a robot.

    The first three numbers are squares of the distances of the middles of cells, in parts of a cell, below which the
    rover does not fit, hardly fits, and should be slow: levels 1 to 3. Below the fourth, the middles of a cell and of a
    suspected one are near each other. The last is the number of cells that the third reaches.
    """
    half_width = robot.footprint.half_width / map_unit(robot)
    tight, near, wide = (math.ceil((half_width + margin) / CELL * PARTS) for margin in MARGINS)
    # A suspected obstacle may be anywhere in its cell.
    return tight**2, near**2, wide**2, (wide + PARTS // 2) ** 2, math.ceil(wide / PARTS)


def reading_of(lidar: LidarConfig, robot: Robot, interval: float) -> tuple[float, ...]:
    """Returns how the scans of a robot are read, in units of its map.

    Position of the lidar; the reading from which on a beam has hit nothing; the number of scans, each after an
    ``interval`` (s), after which a rover that makes no way is stuck; and, for each reading, 1 if the lidar sees there.
    Raises ``ValueError`` if the lidar is too far off center.
    """
    (x, y, z), unit = robot.lidar_position, map_unit(robot)
    if max(abs(x), abs(y)) > FARTHEST_MOUNT * unit:
        raise ValueError(
            f"the lidar must be at most {FARTHEST_MOUNT * unit:g} m from the robot's center along x and y, got {(x, y)}"
        )
    patience = PATIENCE if robot.drive.turns_in_place else MANEUVERS
    in_view = seen(beam_angles(lidar.beams), robot.lidar_view).tensor_split(lidar.points)
    numbers = x / unit, y / unit, z / unit, (lidar.max_range - 1e-3) / unit, float(math.ceil(patience / interval))
    return *numbers, *(float(part.all()) for part in in_view)


def map_unit(robot: Robot) -> float:
    """Returns the unit of lengths of a map, m: the scale of the worlds that the body of the robot needs."""
    return passage_scale(robot, robot.footprint.corner)


def goal_positions(pose: Tensor, imu: Tensor, distance: Tensor, angle: Tensor) -> Tensor:
    """Returns x and y of the goals, ``[N, 2]``, m, from pose and attitude, and distance and angle, ``[N, 1]`` each."""
    bearing = angle + imu[:, 2:]
    return pose[:, :2] + distance * torch.cat((bearing.cos(), bearing.sin()), -1)


def along_heading(pairs: Tensor, imu: Tensor) -> Tensor:
    """Returns world vectors ``[N, M, 2]`` along the axes of each rover's base frame."""
    cos, sin = imu[:, 2:].cos(), imu[:, 2:].sin()
    x, y = pairs.unbind(-1)
    return torch.stack((cos * x + sin * y, cos * y - sin * x), -1)


def in_world(pairs: Tensor, imu: Tensor) -> Tensor:
    """Returns vectors of each rover's base frame ``[N, M, 2]`` along the axes of the world."""
    cos, sin = imu[:, 2:].cos(), imu[:, 2:].sin()
    x, y = pairs.unbind(-1)
    return torch.stack((cos * x - sin * y, sin * x + cos * y), -1)


def relative_route(corners: Tensor, lengths: Tensor, pose: Tensor, imu: Tensor, unit: Tensor) -> Tensor:
    """Returns routes as entries of the observation, ``[N, 5]``, m and rad.

    ``corners [N, 2, 2]``, ``lengths [N]`` and ``pose [N, 3]`` are in the ``unit [N, 1]`` of the map.
    """
    offset = corners - pose[:, None, :2]
    angle = wrap_angle(torch.atan2(offset[..., 1], offset[..., 0]) - imu[:, 2:])
    far = offset.norm(dim=-1) * unit
    # A length of -1 stays.
    length = torch.where(lengths < 0, lengths, lengths * unit[:, 0])
    return torch.cat((torch.stack((far, angle), -1).flatten(1), length[:, None]), -1)
