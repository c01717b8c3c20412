"""What a lidar scan tells about the ground around rovers: the rules that the map and its export share.

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
from torch import Tensor, nn

from rover_rl.envs.config import LidarConfig, RobotLike
from rover_rl.envs.sensors.lidar_mask import WHOLE
from rover_rl.robots import get_robot
from rover_rl.rotations import euler_to_matrix, wrap_angle
from rover_rl.sims.free_space.fitting import passage_scale
from rover_rl.sims.rays import seen
from rover_rl.sims.rover_state import beam_angles

SIZE = 128
"""Number of cells along a side of the window. A power of two."""
HALF = 64
"""Number of cells on each side of the rover's."""
CELL = 0.15
"""Side length of a cell, m."""
PARTS = 16
"""Number of parts along a side of a cell, in which the ends of beams are told apart."""
UNSEEN = -1.0e9
"""Height of a cell whose ground has not been seen, m."""

SUSPECTED = 1
"""Evidence of a cell on rough ground in which a beam has ended: at an obstacle, or at a slope that can be climbed."""
OCCUPIED = 2
"""Evidence from which on a cell counts as occupied."""
HIT = 4
"""Evidence that a reading adds to the cell at its end."""
MOST = 12
"""Largest evidence from readings. Each beam that passes through a cell takes 1 away."""
CLOSED = 15
"""Evidence of a cell that is too steep, or that the rover could not get to. Beams do not change it."""

OPEN = 4
"""Level of a cell far from obstacles. Cells at obstacles have level 0, and :class:`Limits` tells the others."""
DOUBTFUL = 2
"""Highest level of a cell near a suspected one. A route crosses it if a detour is three times as long, or longer."""
MARGINS = (0.01, 0.075, 0.225)
"""Distances of a rover's side from obstacles below which it does not fit, hardly fits, and should be slow, m."""

REACH = 60
"""Number of cells along an axis up to which beams count: 9 m. All of them are in the window, if the lidar is at most
3 cells, 0.45 m, from the rover's center along each axis."""
FARTHEST_MOUNT = 0.45
"""Largest distance of the lidar from the robot's center along x and along y, m."""
NO_GAP = 4.0
"""Distance between the ends of neighboring beams up to which nothing fits between them, cells: 0.6 m."""
LOWEST = -4.0 / 3.0
"""Height of the end of a beam, relative to the lidar, below which it is on the ground, cells: -0.2 m."""
ROUGH_TILT = 0.05
"""Tilt of the rover above which the ground is not level, rad: 3 degrees. On level ground, starting and stopping tilt it
by 0.01 at most."""
MAX_TILT = 0.42
"""Slope above which ground is too steep, rad: 24 degrees. Tires of usual friction (0.5) slide at 26.6."""
FARTHEST_HEIGHT = 20
"""Number of cells along an axis up to which the ends of beams tell heights: 3 m. An error of 1 degree in the tilt
changes the height there by 5 cm."""
STRETCH = 4
"""Number of cells between two heights that are compared, at most: 0.6 m."""
AHEAD = 3.0
"""Distance from the rover at which a cell is closed, in cells: 0.45 m."""
WAY = 0.5
"""Distance up to which a rover is still around a place, m."""
PATIENCE, MANEUVERS = 8.0, 20.0
"""Time in which a rover makes half a meter of way, if it can get on, s: one that turns in place, which takes 3 s for a
half turn, and one that turns around by driving back and forth."""

STATE = (2, 1, 2, 1, 2)
"""Sizes of the parts of a rover's state: the cell in the middle of the window, whether the ground is rough, the place
around which the rover is and its number of scans there, and the first corner of its route. Zeros before an episode."""


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


NUMBERS = 5
"""How many of the numbers of :func:`reading_of` come before those of each reading."""


class ScanReader(nn.Module):
    """Computes what scans tell, from the observation and a small state of each rover.

    ``interval`` is the time from one scan to the next, s.
    """

    _directions: Tensor
    _turn: Tensor
    _seen: Tensor | None
    _reading: Tensor

    def __init__(self, lidar: LidarConfig, robot: RobotLike, interval: float) -> None:
        super().__init__()
        directions, reading = reading_directions(lidar), reading_of(lidar, robot, interval)
        is_seen = torch.tensor(reading[NUMBERS:]) > 0
        # A reading outside of the view is a beam without length, which clears no cell.
        self.register_buffer("_directions", directions * is_seen[:, None])
        self.register_buffer("_turn", directions)
        self.register_buffer("_seen", None if is_seen.all() else is_seen)
        self.register_buffer("_reading", torch.tensor(reading[:NUMBERS]))

    def forward(
        self,
        state: Tensor,
        lidar: Tensor,
        pose: Tensor,
        imu: Tensor,
        reading: Tensor | None = None,
        taken: tuple[Tensor, Tensor] | None = None,
        mask: Tensor | None = None,
    ) -> tuple[Scan, Tensor]:
        """Returns what scans tell, and the next ``STATE`` up to the corner of the route, which is not known yet.

        The arguments are the state before, ``[N, 8]``, entries of the observation in units of the map, ``[N, n]``, the
        :func:`reading_of` different robots, ``[N, NUMBERS + P]``, ``pose`` and ``imu`` at which the scan was taken,
        ``None``: the ones now, and the entry ``lidar_mask``, ``None``: beams cover what is in view.
        """
        numbers, directions, is_seen = self._reading, self._directions, self._seen
        if reading is not None:
            numbers, is_seen = reading[:, :NUMBERS], reading[:, NUMBERS:] > 0
        if mask is not None:
            is_seen = mask > WHOLE if is_seen is None else (mask > WHOLE) & is_seen
        if is_seen is not None and is_seen is not self._seen:
            directions = self._turn * is_seen[..., None]
        mount, no_return, patience = numbers.split((3, 1, 1), -1)
        _, was_rough, place, waits, corner = state.split(STATE, -1)
        axes, xy = euler_to_matrix(_roll_first(imu)), pose[:, :2]
        up = axes[..., 2]
        rough = (was_rough > 0) | (up[:, 2:] < math.cos(ROUGH_TILT))
        center = (xy / CELL).floor()
        at, attitude = taken or (pose, imu)
        tilted = axes if taken is None else euler_to_matrix(_roll_first(attitude))
        origin, beams = self._beams(lidar, at[:, :2], attitude[:, 2:], tilted, mount, directions)
        size, reach = beams[..., :2].abs().amax(-1), torch.full_like(xy[:, :1], REACH)
        if taken is not None:
            # The rover has moved on since the scan, and the window with it.
            late = ((at != pose) | (attitude != imu)).any(-1, keepdim=True)
            reach = torch.where(late, HALF - 1 - (origin - center).abs().amax(-1, keepdim=True), reach).clamp(0, REACH)
            beams = torch.where(late, reach / size.maximum(reach).clamp(min=1e-6), 1.0)[..., None] * beams
        returned = lidar < no_return
        if is_seen is not None:
            returned = returned & is_seen
        ends = returned & (size < reach)
        hits = ends & (beams[..., 2] > LOWEST) & (self._is_steep(beams, tilted[..., 2], mount) | ~rough)
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

    def _beams(
        self, lidar: Tensor, xy: Tensor, yaw: Tensor, axes: Tensor, mount: Tensor, directions: Tensor
    ) -> tuple[Tensor, Tensor]:
        cos, sin = yaw.cos(), yaw.sin()
        offset = mount[..., :1] * torch.cat((cos, sin), -1) + mount[..., 1:2] * torch.cat((-sin, cos), -1)
        ahead, left = axes[:, None, :, 0], axes[:, None, :, 1]
        beams = directions[..., :1] * ahead + directions[..., 1:] * left
        return (xy + offset) / CELL, (lidar / CELL)[..., None] * beams

    def _is_steep(self, beams: Tensor, up: Tensor, mount: Tensor) -> Tensor:
        """Returns whether beams end at an obstacle on rough ground, too, and not at a slope that the rover can climb.

        Some of the ground from below the lidar to the end of the beam is at least as steep as the straight line between
        them. So the end is an obstacle if that line is too steep: on a level rover with the lidar at 0.32 m, within
        0.72 m. Farther ends are suspected ones.
        """
        rise = beams + (mount[..., 2:] / CELL * up)[:, None]
        return rise[..., 2] > math.tan(MAX_TILT) * rise[..., :2].norm(dim=-1)


def _roll_first(imu: Tensor) -> Tensor:
    """Returns roll, pitch and yaw of pitch, roll and yaw, ``[N, 3]``. A list of indices would wait for a GPU."""
    pitch, roll, yaw = imu.split(1, -1)
    return torch.cat((roll, pitch, yaw), -1)


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


def _seen_readings(lidar: LidarConfig, view: float) -> Tensor:
    beams = seen(beam_angles(lidar.beams), view)
    return torch.stack([part.all() for part in beams.tensor_split(lidar.points)])


class Limits(NamedTuple):
    """Squares of the distances from obstacles, in parts of a cell, below which the middles of cells have levels 1 to 3.

    Below ``tight``, the rover does not fit, below ``near``, it hardly fits, below ``wide``, it should be slow. Below
    ``doubt``, the middles of a cell and of a suspected one are near each other.
    """

    tight: int
    near: int
    wide: int
    doubt: int

    @property
    def reach(self) -> int:
        return math.ceil(math.sqrt(self.wide) / PARTS)


def limits_of(robot: RobotLike) -> Limits:
    half_width = get_robot(robot).footprint.half_width / map_unit(robot)
    tight, near, wide = (math.ceil((half_width + margin) / CELL * PARTS) for margin in MARGINS)
    # A suspected obstacle may be anywhere in its cell.
    return Limits(tight**2, near**2, wide**2, (wide + PARTS // 2) ** 2)


def reading_of(lidar: LidarConfig, robot: RobotLike, interval: float) -> tuple[float, ...]:
    """Returns how the scans of a robot are read, in units of its map.

    Position of the lidar; the reading from which on a beam has hit nothing; the number of scans, each after an
    ``interval`` (s), after which a rover that makes no way is stuck; and, for each reading, 1 if the lidar sees there.
    """
    no_return = (lidar.max_range - 1e-3) / map_unit(robot)
    patience = PATIENCE if get_robot(robot).drive.turns_in_place else MANEUVERS
    is_seen = _seen_readings(lidar, get_robot(robot).lidar_view).float().tolist()
    return *lidar_mount(robot), no_return, float(math.ceil(patience / interval)), *is_seen


def map_unit(robot: RobotLike) -> float:
    """Returns the unit of lengths of a map, m: the scale of the worlds that the body of the robot needs."""
    robot = get_robot(robot)
    return passage_scale(robot, robot.footprint.corner)


def lidar_mount(robot: RobotLike) -> tuple[float, float, float]:
    """Returns the position of the lidar in the robot's frame, in units of the map.

    Raises:
        ValueError: if it is too far off center.
    """
    (x, y, z), unit = get_robot(robot).lidar_position, map_unit(robot)
    if max(abs(x), abs(y)) > FARTHEST_MOUNT * unit:
        raise ValueError(
            f"the lidar must be at most {FARTHEST_MOUNT * unit:g} m from the robot's center along x and y, got {(x, y)}"
        )
    return x / unit, y / unit, z / unit


def in_units(unit: float | Tensor, lidar: Tensor, pose: Tensor, target: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns entries of the observation, in meters, in units of the map: of all rows, or of each, ``[N, 1]``."""
    if isinstance(unit, float) and unit == 1:
        return lidar, pose, target
    distance, angle = target.split(1, -1)
    return lidar / unit, pose / unit, torch.cat((distance / unit, angle), -1)


def route_in_meters(unit: float | Tensor, route: Tensor) -> Tensor:
    """Returns routes ``[N, 5]``, whose lengths are in units of the map, in meters. A length of -1 stays."""
    if isinstance(unit, float) and unit == 1:
        return route
    factor = unit if isinstance(unit, Tensor) else route.new_tensor([unit])
    one = torch.ones_like(factor)
    scaled = route * torch.cat((factor, one, factor, one, factor), -1)
    return torch.cat((scaled[:, :4], torch.where(route[:, 4:] < 0, route[:, 4:], scaled[:, 4:])), -1)


def goal_positions(pose: Tensor, imu: Tensor, target: Tensor) -> Tensor:
    """Returns x and y of the goals, ``[N, 2]``, m, from entries of the observation ``[N, n]``."""
    bearing = target[:, 1:] + imu[:, 2:]
    return pose[:, :2] + target[:, :1] * torch.cat((bearing.cos(), bearing.sin()), -1)


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


def relative_route(corners: Tensor, lengths: Tensor, pose: Tensor, imu: Tensor) -> Tensor:
    """Returns routes with ``corners [N, 2, 2]`` and ``lengths [N]`` (m) as entries of the observation, ``[N, 5]``."""
    offset = corners - pose[:, None, :2]
    angle = wrap_angle(torch.atan2(offset[..., 1], offset[..., 0]) - imu[:, 2:])
    return torch.cat((torch.stack((offset.norm(dim=-1), angle), -1).flatten(1), lengths[:, None]), -1)
