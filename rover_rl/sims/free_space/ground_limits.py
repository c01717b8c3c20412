"""Limits that the ground sets to a rover: slopes on which it drives, and headings in which it may rest."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from rover_rl.robots import Robot
from rover_rl.sims.free_space.cell_grid import CellGrid, ring
from rover_rl.worlds.terrain import Terrain

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


def slopes_on_grid(terrain: Terrain, grid: CellGrid) -> np.ndarray:
    """Returns the tangent of the steepest slope at eight points around the center of each cell: ``[rows, columns]``.

    They are at the distance of the corners, between the directions of the edges of the terrain's triangles.
    """
    from rover_rl.native.warp import wp
    from rover_rl.sims.free_space.kernels import measure_slopes
    from rover_rl.worlds.ground_kernels import ground_of

    around = (ring(8, start=math.pi / 8) * grid.half_diagonal).numpy()
    squares = np.empty(grid.shape)
    wp.launch(measure_slopes, len(grid.y), [ground_of(terrain), grid.x, grid.y, around, squares], device="cpu")
    return np.sqrt(squares)


def rest_headings(terrain: Terrain, robot: Robot, grid: CellGrid, cells: Tensor, yaws: Tensor) -> tuple[Tensor, Tensor]:
    """Returns in which headings ``yaws [64, 2]`` (cosine, sine) a rover may rest at centers ``cells [S, 2]`` (m).

    The rover must be upright, and the scan plane above the ground within ``GROUND_CLEARANCE`` of all positions of the
    lidar in the cell. Returns bits of int64, ``[S]``, and the position of the lidar relative to the center of the cell
    at each heading, ``[S, 64, 2]``, m.
    """
    from rover_rl.native.warp import wp
    from rover_rl.sims.free_space.kernels import RINGS, find_rest_headings
    from rover_rl.worlds.ground_kernels import ground_of

    headings = torch.zeros(len(cells), dtype=torch.int64)
    offsets = torch.empty(len(cells), len(yaws), 2, dtype=torch.float64)
    surface = np.empty((len(cells), RINGS * RING_POINTS))
    inputs = [ground_of(terrain), _stance(robot, grid), cells.numpy(), ring(RING_POINTS).numpy(), yaws.numpy(), surface]
    outputs = [offsets.numpy(), headings.numpy().view(np.uint64)]
    wp.launch(find_rest_headings, len(cells), inputs + outputs, device="cpu")
    return headings, offsets


def level_cells(terrain: Terrain, robot: Robot, grid: CellGrid, cells: Tensor) -> Tensor:
    """Returns for which centers ``cells [S, 2]`` (m) :func:`rest_headings` surely allows all headings: bool ``[S]``.

    On rolling ground, this quick test makes free space two to four times as fast. It may miss cells.
    """
    from rover_rl.native.warp import wp
    from rover_rl.sims.free_space.kernels import find_level_cells
    from rover_rl.worlds.ground_kernels import ground_of

    level = torch.zeros(len(cells), dtype=torch.bool)
    inputs = [ground_of(terrain), _stance(robot, grid), cells.numpy(), level.numpy()]
    wp.launch(find_level_cells, len(cells), inputs, device="cpu")
    return level


def _stance(robot: Robot, grid: CellGrid):
    """Returns the dimensions of a rover and the limits for its rest as a struct of the kernels."""
    from rover_rl.native.warp import wp
    from rover_rl.sims.free_space.kernels import Stance

    wheels = np.array(robot.wheels.hubs)[:, :2]
    middle = wheels.mean(0)
    x, y, z = robot.lidar_position
    stance = Stance()
    stance.wheels = wp.array(wheels - middle, dtype=wp.vec2d, device="cpu")
    stance.middle, stance.spread = wp.vec2d(*middle), wp.vec2d(*((wheels - middle) ** 2).sum(0))
    stance.lidar, stance.upright = wp.vec3d(x, y, z), math.cos(MAX_TILT)
    stance.reach = GROUND_CLEARANCE + math.hypot(x, y) + z * math.sin(MAX_TILT) + grid.half_diagonal
    stance.gap = SCAN_GAP
    return stance
