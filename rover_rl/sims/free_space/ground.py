"""Rovers at rest on the ground, and the limits that the ground sets them: slopes, and headings of rest."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from rover_rl.native.warp import wp
from rover_rl.robots import Robot
from rover_rl.sims.free_space import kernels
from rover_rl.sims.free_space.cells import CellGrid, ring
from rover_rl.worlds.ground_kernels import ground_of
from rover_rl.worlds.terrain import Terrain, TerrainRows
from rover_rl.worlds.world import World

CLEARANCE = 5e-4
"""Gap between the lowest wheel and the ground, which avoids initial penetration, m."""
RIM_ANGLE, RIM_POINTS = 1.2, 13
"""Largest angle of the tested points of a wheel's rim from straight down (rad), and their number."""
CLIFF_SLOPE = math.radians(30)
"""Slope above which ground counts as an obstacle, which no part of the rover may be above, rad."""
LANE_WIDTH = 0.4
"""Minimum width of the strip between places that are too steep in which the center of a rover may be, m. On slopes it
slides out of narrower ones."""
MAX_TILT = math.radians(20)
"""Maximum tilt of a rover at a spawn pose, rad."""
GROUND_CLEARANCE = 0.45
"""Minimum distance at which the tilted scan plane meets the ground at a spawn pose, m."""
RING_POINTS = 32
"""Number of points of a ring around a cell at which the ground is tested."""
SCAN_GAP = 0.02
"""Minimum height of the scan plane above the ground within that distance, m."""


def rest_on_ground(ground: World | TerrainRows, robot: Robot, poses: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the poses of rovers that stand on the ground of a world, or on the terrain of each row.

    A rover is aligned with the plane fitted to the ground below its wheels, and raised until no wheel is below the
    ground. ``poses [N, 3]`` are planar: x, y (m) and yaw (rad).

    Returns:
        Position ``[N, 3]`` (m) and rotation matrix ``[N, 3, 3]`` (columns: forward, left, up) of the base frame. Both
        are float64, so that a result does not depend on the size of the batch.
    """
    poses = poses.double()
    hubs, rims = _wheels(robot, poses.device)
    middle = hubs.mean(0)
    arms = hubs - middle
    xy, yaw = poses[:, :2], poses[:, 2]
    ahead = torch.stack((yaw.cos(), yaw.sin()), -1)
    left = torch.stack((-yaw.sin(), yaw.cos()), -1)
    heights = ground.height_at(xy[:, None] + hubs[..., :1] * ahead[:, None] + hubs[..., 1:] * left[:, None])
    # Least squares. The wheels' x and y are uncorrelated, so the slopes are separate regressions.
    slopes = (heights[..., None] * arms).sum(1) / (arms**2).sum(0)
    up = torch.cat((-slopes[:, :1] * ahead - slopes[:, 1:] * left, torch.ones_like(slopes[:, :1])), -1)
    up = up / up.norm(dim=-1, keepdim=True)
    forward = torch.cat((ahead, slopes[:, :1]), -1)
    forward = forward - (forward * up).sum(-1, keepdim=True) * up
    forward = forward / forward.norm(dim=-1, keepdim=True)
    rotation = torch.stack((forward, torch.linalg.cross(up, forward), up), -1)
    height = heights.mean(1) - (slopes * middle).sum(-1)
    position = torch.cat((xy, height[:, None]), -1)
    points = position[:, None] + (rotation[:, None] @ rims[..., None]).squeeze(-1)
    gaps = points[..., 2] - ground.height_at(points[..., :2])
    position[:, 2] += CLEARANCE - gaps.min(-1).values
    return position, rotation


@lru_cache(maxsize=16)
def _wheels(robot: Robot, device: torch.device) -> tuple[Tensor, Tensor]:
    """Centers of the wheels ``[W, 2]`` and points on the lower half of their rims ``[P, 3]``, m."""
    hubs = torch.tensor(robot.wheels.hubs, dtype=torch.float64, device=device)
    angle = torch.linspace(-RIM_ANGLE, RIM_ANGLE, RIM_POINTS, dtype=torch.float64, device=device)
    half = robot.wheels.width / 2
    across = torch.tensor((-half, 0.0, half), dtype=torch.float64, device=device)
    arc = robot.wheels.radius * torch.stack((angle.sin(), -angle.cos()), -1)
    (x, z), y = arc.T[..., None].expand(2, -1, 3), across.expand(angle.numel(), 3)
    return hubs[:, :2], (hubs[:, None] + torch.stack((x, y, z), -1).reshape(-1, 3)).reshape(-1, 3)


def slopes_on_grid(terrain: Terrain, grid: CellGrid) -> np.ndarray:
    """Tangent of the steepest slope at eight points around the center of each cell: ``[rows, columns]``."""
    # At the distance of the corners, between the directions of the edges of the terrain's triangles.
    around = (ring(8, start=math.pi / 8) * grid.half_diagonal).numpy()
    squares = np.empty(grid.shape)
    inputs = [ground_of(terrain), grid.x, grid.y, around, squares]
    wp.launch(kernels.measure_slopes, len(grid.y), inputs, device="cpu")
    return np.sqrt(squares)


def rest_headings(terrain: Terrain, robot: Robot, grid: CellGrid, cells: Tensor, yaws: Tensor) -> tuple[Tensor, Tensor]:
    """Headings of ``yaws [64, 2]`` (cosine, sine) in which a rover may rest at centers ``cells [S, 2]``, m.

    The rover must be upright, and the scan plane above the ground within ``GROUND_CLEARANCE`` of all positions of the
    lidar in the cell. Returns bits of int64 ``[S]``, and the position of the lidar relative to the center of the cell
    at each heading, ``[S, 64, 2]``, m.
    """
    headings = torch.zeros(len(cells), dtype=torch.int64)
    offsets = torch.empty(len(cells), len(yaws), 2, dtype=torch.float64)
    surface = np.empty((len(cells), kernels.RINGS * RING_POINTS))
    inputs = [ground_of(terrain), _stance(robot, grid), cells.numpy(), ring(RING_POINTS).numpy(), yaws.numpy(), surface]
    outputs = [offsets.numpy(), headings.numpy().view(np.uint64)]
    wp.launch(kernels.find_rest_headings, len(cells), inputs + outputs, device="cpu")
    return headings, offsets


def _stance(robot: Robot, grid: CellGrid) -> kernels.Stance:
    wheels = np.array(robot.wheels.hubs)[:, :2]
    middle = wheels.mean(0)
    x, y, z = robot.lidar_position
    stance = kernels.Stance()
    stance.wheels = wp.array(wheels - middle, dtype=wp.vec2d, device="cpu")
    stance.middle, stance.spread = wp.vec2d(*middle), wp.vec2d(*((wheels - middle) ** 2).sum(0))
    stance.lidar, stance.upright = wp.vec3d(x, y, z), math.cos(MAX_TILT)
    stance.reach = GROUND_CLEARANCE + math.hypot(x, y) + z * math.sin(MAX_TILT) + grid.half_diagonal
    stance.gap = SCAN_GAP
    return stance
