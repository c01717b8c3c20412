"""Free space of a world for one robot: a grid of passable cells, spawn poses and goals."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from scipy.ndimage import label
from torch import Tensor

from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds.clearance import clearance_on_grid
from rover_rl.sims.worlds.free_space_cache import load_free_space, store_free_space
from rover_rl.sims.worlds.placement import ground_frame
from rover_rl.sims.worlds.world import Area, World

HEADINGS = 64
"""Number of heading bins. Bin k covers yaw from ``-pi + 2 pi k / 64`` to ``-pi + 2 pi (k + 1) / 64``."""
CELL = 0.1
"""Side length of a cell, m."""
MAX_SLOPE = math.radians(25)
"""Maximum slope of passable ground, rad."""
MAX_TILT = math.radians(20)
"""Maximum tilt of a rover at a spawn pose, rad."""
LIDAR_CLEARANCE = 0.4
"""Minimum distance of obstacles from the lidar at a spawn pose, m."""
GROUND_CLEARANCE = 0.45
"""Minimum distance at which the tilted scan plane meets the ground at a spawn pose, m."""
MIN_GOAL_DISTANCE = 1.0
"""Minimum distance of the farthest goal from every spawn cell and goal cell, m."""
EXTRA_CLEARANCE = 1.0
"""Margin up to which obstacle distances are exact, beyond the robot's radius plus the lidar clearance, m."""
TILT_MARGIN = 0.02
"""Maximum horizontal displacement of the lidar by different tilts of the rover within a cell, m."""
CHUNK = 64
"""Number of cells whose headings are checked at once, which limits the memory to about 15 MB."""


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """Free cells of a world for one robot, created by :func:`free_space`.

    All spawn and goal cells are connected: every goal is reachable from every spawn cell. A sampled position is the
    center of a cell plus an offset of up to half a ``cell`` in x and y. A sampled heading is anywhere in its bin.

    Attributes:
        cell: side length of a cell, m.
        origin: x, y of the center of ``passable[0, 0]``, m.
        passable: whether the rover's center may be anywhere in a cell, bool ``[rows, columns]``. Rows are along y.
        spawn_cells: centers of the cells in which episodes start, ``[S, 2]``, m, float64.
        spawn_headings: allowed heading bins of each spawn cell, at least one: bit k of an int64 is bin k, ``[S]``.
        goal_cells: centers of the cells that may contain goals, ``[G, 2]``, m, float64.
        goal_extremes: outermost goal cells in 16 directions, ``[16, 2]``, m, float64. For every spawn position and
            every goal, at least one of them is 1 m or more away.
    """

    cell: float
    origin: tuple[float, float]
    passable: Tensor
    spawn_cells: Tensor
    spawn_headings: Tensor
    goal_cells: Tensor
    goal_extremes: Tensor

    def to(self, device: torch.device | str | None) -> FreeSpace:
        """Returns a copy with its tensors on ``device``. ``None`` is the CPU."""
        tensors = ("passable", "spawn_cells", "spawn_headings", "goal_cells", "goal_extremes")
        moved: dict[str, Any] = {name: getattr(self, name).to(device or "cpu") for name in tensors}
        return replace(self, **moved)

    def contains(self, xy: Tensor) -> Tensor:
        """Returns whether the rover's center may be at points ``xy [..., 2]`` (m): bool ``[...]``."""
        passable = self.passable.to(xy.device)
        limits = torch.tensor(passable.shape[::-1], device=xy.device)
        index = ((xy - torch.tensor(self.origin, dtype=xy.dtype, device=xy.device)) / self.cell + 0.5).floor()
        inside = ((index >= 0) & (index < limits)).all(-1)
        column, row = torch.where(inside[..., None], index, 0.0).long().unbind(-1)
        return inside & passable[row, column]


def free_space(world: World, robot: Robot) -> FreeSpace:
    """Returns the free space of a world for a robot.

    It is computed once, and stored on disk by the content of the world and the robot
    (:mod:`rover_rl.sims.worlds.free_space_cache`).

    Raises:
        ValueError: if there is no spawn cell or no goal cell, or the goals lie too close together.
    """
    by_robot = _cache.setdefault(world, {})
    if robot not in by_robot:
        stored = load_free_space(FreeSpace, world, robot)
        by_robot[robot] = stored or _compute(world, robot)
        if stored is None:
            store_free_space(world, robot, by_robot[robot])
    return by_robot[robot]


_cache: WeakKeyDictionary[World, dict[Robot, FreeSpace]] = WeakKeyDictionary()


def _compute(world: World, robot: Robot) -> FreeSpace:
    grid = _Grid(overlap(world.bounds, world.terrain.extent))
    clearance = clearance_on_grid(world, grid.x, grid.y, robot.radius + LIDAR_CLEARANCE + EXTRA_CLEARANCE)
    passable = _passable(world, robot, grid, clearance)
    goal, spawn = (passable & grid.within(area) for area in (world.goal_range, world.spawn_range))
    # Keep the connected part with the most goals, which are unreachable from all other parts.
    parts, count = label(passable)
    part = parts == np.bincount(parts[goal], minlength=count + 1).argmax()
    goal_cells, spawn_cells = grid.centers[goal & part], grid.centers[spawn & part]
    _check_any(world, robot, "goal", goal_cells)

    if world.terrain.is_flat:
        headings = _headings_on_flat(robot, grid, clearance, spawn_cells)
    else:
        headings = torch.cat([_headings(world, robot, grid, clearance, cells) for cells in spawn_cells.split(CHUNK)])
    spawn_cells, headings = spawn_cells[headings != 0], headings[headings != 0]
    _check_any(world, robot, "spawn", spawn_cells)
    return FreeSpace(
        cell=grid.cell,
        origin=grid.origin,
        passable=torch.from_numpy(passable),
        spawn_cells=spawn_cells,
        spawn_headings=headings,
        goal_cells=goal_cells,
        goal_extremes=_extremes(world, goal_cells, spawn_cells, grid.cell),
    )


def _check_any(world: World, robot: Robot, kind: str, cells: Tensor) -> None:
    if len(cells) == 0:
        area = getattr(world, f"{kind}_range")
        raise ValueError(f"world {world.name!r} has no free {kind} cell for {robot.name!r} in {kind}_range {area}")


def _extremes(world: World, goal_cells: Tensor, spawn_cells: Tensor, cell: float) -> Tensor:
    """Returns the outermost goal cells in 16 directions: ``[16, 2]``, m."""
    extremes = goal_cells[(goal_cells @ _ring(16).T).argmax(0)]
    farthest = torch.cdist(torch.cat((spawn_cells, goal_cells)), extremes).amax(1)
    if farthest.min() < MIN_GOAL_DISTANCE + cell:
        raise ValueError(
            f"the goal cells of world {world.name!r} lie so close together that from some places none is "
            f"{MIN_GOAL_DISTANCE} m away; goal_range is {world.goal_range}"
        )
    return extremes


def overlap(a: Area, b: Area) -> Area:
    """Returns the intersection of two areas, which is empty (low >= high) if they are disjoint."""
    x, y = ((max(p[0], q[0]), min(p[1], q[1])) for p, q in zip(a, b, strict=True))
    return x, y


class _Grid:
    """Square cells that tile an area, with rows along y and at least two cells per axis for interpolation."""

    def __init__(self, area: Area) -> None:
        self.cell = CELL
        self.area = area
        self.x, self.y = (self._axis(*ends) for ends in area)
        self.origin = (float(self.x[0]), float(self.y[0]))
        self.centers = torch.from_numpy(np.stack(np.meshgrid(self.x, self.y), -1))
        self.half_diagonal = self.cell / math.sqrt(2)

    def _axis(self, low: float, high: float) -> np.ndarray:
        count = max(2, math.floor((high - low) / self.cell + 1e-6))
        return low + self.cell * (np.arange(count) + 0.5)

    def within(self, area: Area) -> np.ndarray:
        """Returns which cells lie entirely in ``area``: bool ``[rows, columns]``."""
        half = self.cell / 2 - 1e-6
        (x_low, x_high), (y_low, y_high) = area
        in_x = (self.x - half >= x_low) & (self.x + half <= x_high)
        in_y = (self.y - half >= y_low) & (self.y + half <= y_high)
        return in_y[:, None] & in_x


def distance_to_polygon(points: Tensor, polygon: Tensor) -> Tensor:
    """Returns the distance from ``points [..., 2]`` to a convex polygon, 0 inside it: ``[...]``.

    Args:
        points: points, ``[..., 2]``.
        polygon: vertices in counter-clockwise order, ``[K, 2]``.
    """
    edges = polygon.roll(-1, 0) - polygon
    offsets = points[..., None, :] - polygon
    along = ((offsets * edges).sum(-1) / (edges**2).sum(-1)).clamp(0, 1)
    distance = (offsets - along[..., None] * edges).norm(dim=-1).amin(-1)
    inside = (edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0] >= 0).all(-1)
    return distance.masked_fill(inside, 0.0)


def _passable(world: World, robot: Robot, grid: _Grid, clearance: Tensor) -> np.ndarray:
    """Returns the cells with enough clearance for the rover and gentle enough ground: bool ``[rows, columns]``."""
    free = clearance.numpy() >= robot.radius + grid.half_diagonal
    x, y = ((low + robot.radius, high - robot.radius) for low, high in grid.area)
    free &= grid.within((x, y))
    if world.terrain.is_flat:
        return free
    # Directions around each cell, between those of the edges of the terrain's triangles.
    around = _ring(8, start=math.pi / 8) * grid.half_diagonal
    steepest = torch.stack([world.normal_at(grid.centers + offset)[..., 2] for offset in around]).amin(0)
    return free & (steepest.numpy() >= math.cos(MAX_SLOPE))


def _headings(world: World, robot: Robot, grid: _Grid, clearance: Tensor, cells: Tensor) -> Tensor:
    """Returns the allowed heading bins of spawn cells with centers ``cells [S, 2]``, as bits of int64: ``[S]``.

    A bin is allowed if its two end headings are. The margins cover all headings in between and the whole cell.
    """
    yaws = torch.arange(HEADINGS, dtype=torch.float64) * (2 * math.pi / HEADINGS) - math.pi
    poses = torch.cat((cells.repeat_interleave(HEADINGS, 0), yaws.repeat(len(cells))[:, None]), -1)
    height, rotation = ground_frame(world, robot, poses)
    lidar = torch.tensor(robot.lidar_position, dtype=torch.float64)
    upright = rotation[:, 2, 2] >= math.cos(MAX_TILT)

    half_bin = float(lidar[:2].norm()) * math.pi / HEADINGS
    margin = grid.half_diagonal + half_bin + TILT_MARGIN
    lidar_xy = poses[:, :2] + (rotation @ lidar)[:, :2]
    clear = _interpolate(grid, clearance, lidar_xy) >= LIDAR_CLEARANCE + margin

    # The scan plane must be above the ground within GROUND_CLEARANCE of the lidar, for all positions of the lidar.
    reach = GROUND_CLEARANCE + float(lidar[:2].norm() + lidar[2] * math.sin(MAX_TILT)) + grid.half_diagonal
    around = (reach / 4 * torch.arange(1, 5)[:, None, None] * _ring(32)).reshape(-1, 2)
    ground = world.height_at(cells[:, None] + around)
    up = rotation[:, :, 2]
    plane = (height + lidar[2] / up[:, 2])[:, None] - (up[:, :2] / up[:, 2:]) @ around.T
    above = (plane.reshape(len(cells), HEADINGS, len(around)) > ground[:, None] + 0.02).all(-1)

    good = (upright & clear).reshape(len(cells), HEADINGS) & above
    return ((good & good.roll(-1, 1)).long() << torch.arange(HEADINGS)).sum(1)


def _headings_on_flat(robot: Robot, grid: _Grid, clearance: Tensor, cells: Tensor) -> Tensor:
    """Returns the same as :func:`_headings` on flat ground, where only the obstacles near the lidar count."""
    from rover_rl.sims.native.warp import wp
    from rover_rl.sims.worlds.grid_kernels import find_headings

    yaw = torch.arange(HEADINGS, dtype=torch.float64) * (2 * math.pi / HEADINGS) - math.pi
    ahead, left = robot.lidar_position[:2]
    offsets = torch.stack((ahead * yaw.cos() - left * yaw.sin(), ahead * yaw.sin() + left * yaw.cos()), -1)
    margin = grid.half_diagonal + math.hypot(ahead, left) * math.pi / HEADINGS + TILT_MARGIN
    headings = torch.zeros(len(cells), dtype=torch.int64)
    arrays = [array.contiguous().numpy() for array in (cells, offsets, clearance)]
    inputs = [*arrays, wp.vec2d(*grid.origin), grid.cell, LIDAR_CLEARANCE + margin, headings.numpy()]
    wp.launch(find_headings, dim=len(cells), inputs=inputs, device="cpu")
    return headings


def _ring(count: int, start: float = 0.0) -> Tensor:
    """Returns evenly spaced unit vectors, the first at the angle ``start`` (rad): ``[count, 2]``."""
    angle = start + 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    return torch.stack((angle.cos(), angle.sin()), -1)


def _interpolate(grid: _Grid, values: Tensor, xy: Tensor) -> Tensor:
    """Interpolates a field ``[rows, columns]`` at the cells' centers bilinearly to points ``[N, 2]``: ``[N]``."""
    rows, columns = values.shape
    u = ((xy[:, 0] - grid.origin[0]) / grid.cell).clamp(0, columns - 1)
    v = ((xy[:, 1] - grid.origin[1]) / grid.cell).clamp(0, rows - 1)
    i, j = u.long().clamp(max=columns - 2), v.long().clamp(max=rows - 2)
    u, v = u - i, v - j
    lower = (1 - u) * values[j, i] + u * values[j, i + 1]
    upper = (1 - u) * values[j + 1, i] + u * values[j + 1, i + 1]
    return (1 - v) * lower + v * upper
