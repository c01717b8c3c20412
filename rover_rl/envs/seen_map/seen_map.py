"""``SeenMap``: what the lidars of a batch of rovers have seen, and the routes to their goals on it.

Example:
    >>> env = RoverEnv(world_n="maze", num_envs=2, seed=0)
    >>> seen = SeenMap(2, env.config.lidar)
    >>> seen(env.reset()).shape
    torch.Size([2, 5])
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.envs.config import LidarConfig
from rover_rl.sims.robots import Robot, get_robot
from rover_rl.sims.robots.footprint import footprint
from rover_rl.sims.rotations import wrap_angle

if TYPE_CHECKING:
    from rover_rl.envs.seen_map.cell_kernels import Clearance

ROUTE = "route"
"""Name of the route in an observation."""
ROUTE_KEYS = ("lidar", "pose", "imu", "target")
"""Entries of an observation that the map and the route are computed from."""
BOUNDS = "bounds"
"""Name of the area that routes stay in: lower x and y, and upper x and y, ``[N, 4]``, m."""
NO_BOUNDS = (-1e6, -1e6, 1e6, 1e6)
"""Area without bounds."""

FARTHEST_MOUNT = 0.45
"""Largest distance of the lidar from the robot's center along x and along y, m."""

PATIENCE = 8.0
"""Time in which a rover makes half a meter of way, if it can get on, s. Turning around takes 3 s."""

MARGINS = (0.01, 0.075, 0.225)
"""Distances of a rover's side from obstacles below which it does not fit, hardly fits, and should be slow, m."""


def lidar_mount(robot: str | Robot) -> tuple[float, float, float]:
    """Returns the position of the lidar in the frame of the robot, whose origin is on the ground, m.

    Raises:
        ValueError: if the lidar is mounted too far from the robot's center.
    """
    x, y, z = get_robot(robot).lidar_position
    if max(abs(x), abs(y)) > FARTHEST_MOUNT:
        raise ValueError(
            f"the lidar must be at most {FARTHEST_MOUNT} m from the robot's center along x and y, got {(x, y)}"
        )
    return x, y, z


def beam_directions(lidar: LidarConfig, device: torch.device | str | None = None) -> Tensor:
    """Returns cosine and sine of the angle of each reading in the frame of the lidar, ``[points, 2]``."""
    # A reading is the minimum over several beams: the angle is that of their center.
    share = lidar.beams / lidar.points
    angles = (torch.arange(lidar.points, device=device) * share + (share - 1) / 2) * (2 * math.pi / lidar.beams)
    return torch.stack((angles.cos(), angles.sin()), -1)


def largest_reading(lidar: LidarConfig) -> float:
    """Returns the reading from which on a beam has hit nothing, m."""
    return lidar.max_range - 1e-3


def clearance_of(robot: str | Robot) -> Clearance:
    """Returns the distances from obstacles at which the levels of cells begin, in parts of a cell."""
    from rover_rl.envs.seen_map.cell_kernels import CELL, PARTS, Clearance

    half_width = footprint(get_robot(robot)).half_width
    tight, near, wide = (math.ceil((half_width + margin) / CELL * PARTS) for margin in MARGINS)
    clearance = Clearance()
    clearance.tight, clearance.near, clearance.wide = tight**2, near**2, wide**2
    # A suspected obstacle may be anywhere in its cell.
    clearance.doubt = (wide + PARTS // 2) ** 2
    clearance.reach = math.ceil(wide / PARTS)
    return clearance


def patience_of(interval: float) -> int:
    """Returns the number of scans within which a rover makes its way, if it can get on.

    Args:
        interval: time from one scan to the next, s.
    """
    return math.ceil(PATIENCE / interval)


def goal_positions(pose: Tensor, imu: Tensor, target: Tensor) -> Tensor:
    """Returns x and y of the goals, ``[N, 2]``, m, from entries of the observation ``[N, n]``."""
    bearing = target[:, 1:] + imu[:, 2:]
    return pose[:, :2] + target[:, :1] * torch.cat((bearing.cos(), bearing.sin()), -1)


def relative_route(corners: Tensor, lengths: Tensor, pose: Tensor, imu: Tensor) -> Tensor:
    """Returns routes as entries of the observation, ``[N, 5]``: see :class:`SeenMap`.

    Args:
        corners: x and y of two corners, ``[N, 2, 2]``, m.
        lengths: lengths of the routes, ``[N]``, m.
        pose: x, y and z of the rovers, ``[N, 3]``, m.
        imu: pitch, roll and yaw of the rovers, ``[N, 3]``, rad.
    """
    offset = corners - pose[:, None, :2]
    angle = wrap_angle(torch.atan2(offset[..., 1], offset[..., 0]) - imu[:, 2:])
    return torch.cat((torch.stack((offset.norm(dim=-1), angle), -1).flatten(1), lengths[:, None]), -1)


class SeenMap:
    """Maps of the obstacles that rovers have seen in their episodes, and the shortest routes on them.

    Each row has its own map: a window of 19.2 m around the rover, in cells of 0.15 m, which moves with it. The end of a
    beam marks a cell as occupied, and beams that pass through a cell clear it. What has not been seen counts as free,
    so that routes lead into the unknown if that may be shorter. Once its end has been seen, no route leads into a dead
    end any more.

    What the lidar does not see is found out by driving. Where the rover tilts by more than 24 degrees, the ground ahead
    uphill counts as occupied. If the rover does not get farther than half a meter in 8 s, the place 0.45 m ahead on its
    route does.

    The lidar scans in one plane, so that a gentle slope ahead looks like a wall. On rough ground, that is once the
    rover has tilted by more than 3 degrees in the episode, the end of a beam therefore marks a cell only if the ground
    rises to it by more than 24 degrees: on a level rover with the lidar at 0.32 m, within 0.72 m. At other ends, an
    obstacle is suspected: a route crosses them only if the detour around them is much longer. The rover itself and the
    ends of beams up to 3 m away also tell how high the ground is. Where two heights differ by more than a slope of 24
    degrees allows, the place between them counts as occupied for the rest of the episode.

    The map needs a pose that does not jump, such as that of odometry.

    Args:
        rows: number N of rovers.
        lidar: settings of the lidar; ``None``: the defaults.
        robot: robot, or its name, for the position of the lidar.
        device: device of the observations; ``None``: the CPU.
        threads: number of CPU threads. Results do not depend on it.
        interval: time from one scan that is added to the next, s.

    Raises:
        ValueError: if the lidar is mounted too far from the robot's center.
    """

    def __init__(
        self,
        rows: int,
        lidar: LidarConfig | None = None,
        robot: str | Robot = "rover_zero",
        device: torch.device | str | None = None,
        threads: int = 1,
        interval: float = 0.2,
    ) -> None:
        # Importing NVIDIA Warp takes half a second.
        from rover_rl.envs.seen_map.cell_kernels import OPEN, SIZE, UNSEEN
        from rover_rl.envs.seen_map.route_kernels import BUCKETS

        lidar, device = lidar or LidarConfig(), torch.device(device or "cpu")
        self._mount, self._max_range, self._patience = lidar_mount(robot), largest_reading(lidar), patience_of(interval)
        cells = (rows, SIZE * SIZE)
        self._every = torch.ones(rows, dtype=torch.bool, device=device)
        self._renewed, self._rough = self._every.clone(), ~self._every
        self._places = torch.zeros(rows, 2, device=device)
        self._waits = torch.zeros(rows, dtype=torch.int32, device=device)
        self._unbounded = torch.tensor(NO_BOUNDS, device=device).repeat(rows, 1)
        self._centers = torch.zeros(rows, 2, dtype=torch.int32, device=device)
        self._evidence = torch.zeros(cells, dtype=torch.uint8, device=device)
        self._boxes = torch.zeros(cells, dtype=torch.int32, device=device)
        self._levels = torch.full(cells, OPEN, dtype=torch.uint8, device=device)
        self._doubts = torch.zeros(cells, dtype=torch.int16, device=device)
        self._heights = torch.full(cells, UNSEEN, device=device)
        self._clearance = clearance_of(robot)
        # x and y of two corners, and the length.
        self._corners = torch.zeros(rows, 2, 2, device=device)
        self._lengths = torch.zeros(rows, device=device)
        # On an accelerator, each thread plans for one row. On the CPU, each one plans for a share of them.
        on_gpu = device.type == "cuda"
        self._shares = [*pairwise(torch.linspace(0, rows, 1 + (1 if on_gpu else min(threads, rows))).long().tolist())]
        self._pool = ThreadPoolExecutor(len(self._shares) - 1) if len(self._shares) > 1 else None
        sizes = (cells[1], BUCKETS, cells[1], cells[1])
        self._memory = [
            [torch.empty(rows if on_gpu else 1, size, dtype=torch.int32, device=device) for size in sizes]
            for _ in self._shares
        ]
        self._directions = beam_directions(lidar, device)

    def __call__(
        self,
        observation: TensorDictBase,
        rows: Tensor | None = None,
        renewed: Tensor | None = None,
        bounds: Tensor | None = None,
    ) -> Tensor:
        """Adds the scans of an observation to the maps and plans the routes to the goals.

        Args:
            observation: observation ``[N]`` with ``lidar``, ``pose``, ``imu`` and ``target``.
            rows: rows whose scan is added, bool ``[N]``; ``None``: all. The maps of the others stay as they are.
            renewed: rows whose episode begins, bool ``[N]``. Their maps are cleared before.
            bounds: area that the routes stay in: lower x and y and upper x and y, ``[N, 4]``, m; ``None``: no bounds.

        Returns:
            Routes, float32 ``[N, 5]``: distance (m) and angle (rad, relative to the rover's heading) of the first and
            the second corner, and the length (m). The goal counts as a corner. In the length, a meter beside an
            obstacle counts more, up to ten. Without a path, both corners are the goal, and the length is -1.
        """
        rows = self._every if rows is None else rows
        if renewed is not None:
            self._renewed |= renewed
        pose, imu, target = observation["pose"], observation["imu"], observation["target"]
        goal = goal_positions(pose, imu, target)
        bounds = self._unbounded if bounds is None else bounds
        poses, readings = torch.cat((pose[:, :2], imu, pose[:, 2:]), -1), observation["lidar"].contiguous()
        self._launch(poses, readings, goal, bounds.contiguous(), rows.contiguous())
        self._renewed &= ~rows
        return relative_route(self._corners, self._lengths, pose, imu)

    def levels(self) -> tuple[Tensor, Tensor]:
        """Returns how far the cells are from obstacles.

        Returns:
            Levels, uint8 ``[N, rows, columns]``: 0 in cells with an obstacle or closed ones, 1 where the rover does not
            fit, 2 where it hardly fits or an obstacle is suspected, 3 where it should be slow, and 4 elsewhere. And x,
            y of the lower corner of cell ``[0, 0]`` of each row's window, float32 ``[N, 2]``, m.
        """
        from rover_rl.envs.seen_map.cell_kernels import CELL, DOUBTFUL, HALF, SIZE

        levels = torch.where(self._doubts > 0, self._levels.clamp(max=DOUBTFUL), self._levels)
        lowest = self._centers - HALF
        # A cell is stored at its number modulo the size.
        columns, rows = ((lowest[:, axis, None] + torch.arange(SIZE, device=lowest.device)) % SIZE for axis in range(2))
        address = rows[:, :, None] * SIZE + columns[:, None]
        return levels.gather(1, address.flatten(1).long()).reshape(address.shape), lowest * CELL

    def _launch(self, poses: Tensor, readings: Tensor, goals: Tensor, bounds: Tensor, rows: Tensor) -> None:
        """Launches the kernels. Poses are x, y, pitch, roll, yaw and z, ``[N, 6]``."""
        from rover_rl.envs.seen_map.route_kernels import plan_routes
        from rover_rl.envs.seen_map.scan_kernels import add_scans
        from rover_rl.sims.native.warp import wp

        device = wp.device_from_torch(poses.device)
        options = {"device": device, "stream": wp.stream_from_torch(poses.device) if device.is_cuda else None}
        centers = wp.from_torch(self._centers, dtype=wp.vec2i)
        directions = wp.from_torch(self._directions, dtype=wp.vec2)
        scans = [poses, readings, directions, self._mount, self._max_range, self._clearance, self._patience]
        scans += [rows, self._renewed, self._rough, self._places, self._waits]
        scans += [centers, self._evidence, self._boxes, self._levels, self._doubts]
        scans += [self._heights, self._corners]
        plans = [goals, bounds, rows, centers, self._levels, self._doubts]

        def launch(share: tuple[int, int], memory: list[Tensor]) -> None:
            first, last = share
            wp.launch(add_scans, last - first, [*scans, first], **options)
            inputs = [*plans, *memory, self._corners, self._lengths, first, last]
            wp.launch(plan_routes, len(memory[0]), inputs, **options)

        parts = list(zip(self._shares, self._memory, strict=True))
        others = [self._pool.submit(launch, *part) for part in parts[1:]] if self._pool else []
        launch(*parts[0])
        for other in others:
            other.result()
