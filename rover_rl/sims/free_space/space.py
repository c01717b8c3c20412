"""Free space of a world for one robot: a grid of passable cells, spawn poses and goals."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from scipy.ndimage import binary_opening
from torch import Tensor

from rover_rl import robots, worlds
from rover_rl.native.warp import wp
from rover_rl.robots import Robot
from rover_rl.sims.free_space import ground, passages
from rover_rl.sims.free_space.cells import ALL_ORIENTATIONS, CellGrid, cells_of, distance_to_cells, ring
from rover_rl.sims.free_space.kernels import find_headings
from rover_rl.worlds import cache
from rover_rl.worlds.clearance import clearance_on_grid
from rover_rl.worlds.region import overlap
from rover_rl.worlds.terrain import MAX_SLOPE
from rover_rl.worlds.world import World

HEADINGS = 64
"""Number of heading bins. Bin k covers yaw from ``-pi + 2 pi k / 64`` to ``-pi + 2 pi (k + 1) / 64``."""
LIDAR_CLEARANCES = (0.4, 0.3, 0.0)
"""Minimum distance of obstacles from the lidar at a spawn pose, m: the first for which there is any spawn pose."""
MIN_GOAL_DISTANCE = 1.0
"""Minimum distance of the farthest goal from every spawn cell and goal cell, m."""
EXTRA_CLEARANCE = 0.2
"""Margin up to which obstacle distances are exact, beyond the robot's radius plus the lidar clearance, m."""
TILT_MARGIN = 0.02
"""Maximum horizontal displacement of the lidar by different tilts of the rover within a cell, m."""
CHUNK = 4096
"""Number of cells on uneven ground whose headings are checked at once, which limits the memory to about 10 MB."""


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """Free cells of a world for one robot, created by :func:`free_space`.

    Cells are roomy or narrow. In a roomy cell, the turning circle is free wherever in the cell the rover is. Episodes
    start and end in roomy cells. Narrow cells count only where they join roomy cells of the spawn and goal areas that
    are otherwise separate: the footprint is free at their centers in some orientations, in which the rover drives
    through, forward or backward.

    All spawn and goal cells are connected: every goal is reachable from every spawn cell. A sampled position is the
    center of a cell plus an offset of up to half a ``cell`` in x and y. A sampled heading is anywhere in its bin.

    A robot that does not turn in place starts with a free way straight ahead, as long as the radius of its sharpest
    turn. Whether a car gets from everywhere to everywhere is not computed: roomy cells are connected for its disc.

    Attributes:
        cell: side length of a cell, m.
        origin: x, y of the center of ``passable[0, 0]``, m.
        passable: cells that are roomy or narrow, bool ``[rows, columns]``. Rows are along y.
        roomy: cells with a free turning circle, bool ``[rows, columns]``.
        narrow_orientations: orientations in which the rover reaches the center of each narrow cell, in the order of
            ``passable & ~roomy``: bit k of an int64, of 32, is the yaw ``2 pi k / 64`` and its opposite, ``[M]``.
        spawn_cells: centers of the cells in which episodes start, ``[S, 2]``, m, float64.
        spawn_headings: allowed heading bins of each spawn cell, at least one: bit k of an int64 is bin k, ``[S]``.
        goal_cells: centers of the cells that may contain goals, ``[G, 2]``, m, float64.
        goal_extremes: outermost goal cells in 16 directions, ``[16, 2]``, m, float64. For every spawn position and
            every goal, at least one of them is 1 m or more away.
    """

    cell: float
    origin: tuple[float, float]
    passable: Tensor
    roomy: Tensor
    narrow_orientations: Tensor
    spawn_cells: Tensor
    spawn_headings: Tensor
    goal_cells: Tensor
    goal_extremes: Tensor

    def to(self, device: torch.device | str | None) -> FreeSpace:
        """Returns a copy with its tensors on ``device``. ``None`` is the CPU."""
        moved: dict[str, Any] = {name: value.to(device or "cpu") for name, value in self._tensors()}
        return replace(self, **moved)

    def _tensors(self) -> list[tuple[str, Tensor]]:
        return [(name, value) for name, value in vars(self).items() if isinstance(value, Tensor)]

    def contains(self, xy: Tensor) -> Tensor:
        """Whether points ``xy [..., 2]`` (m) lie in passable cells: bool ``[...]``."""
        passable = self.passable.to(xy.device)
        limits = torch.tensor(passable.shape[::-1], device=xy.device)
        index = ((xy - torch.tensor(self.origin, dtype=xy.dtype, device=xy.device)) / self.cell + 0.5).floor()
        inside = ((index >= 0) & (index < limits)).all(-1)
        column, row = torch.where(inside[..., None], index, 0.0).long().unbind(-1)
        return inside & passable[row, column]

    def orientations(self) -> Tensor:
        """Orientations of the rover in each cell, all in a roomy one: bits of int64, ``[rows, columns]``."""
        masks = torch.where(self.roomy, ALL_ORIENTATIONS, 0)
        masks[self.passable & ~self.roomy] = self.narrow_orientations
        return masks


def free_space(world: World, robot: Robot) -> FreeSpace:
    """Returns the free space of a world for a robot.

    It is computed once, and stored by the content of the world and the robot in the folder of the cache.

    Raises:
        ValueError: if there is no spawn cell or no goal cell, or the goals lie too close together.
    """
    by_robot = _cache.setdefault(world, {})
    if robot not in by_robot:
        by_robot[robot] = _stored(world, robot)
    return by_robot[robot]


_cache: WeakKeyDictionary[World, dict[Robot, FreeSpace]] = WeakKeyDictionary()
_CELLS = ("passable", "roomy", "spawn_cells", "goal_cells")
"""What is stored as a bit for each cell of the grid: booleans, and lists of cells."""


def _stored(world: World, robot: Robot) -> FreeSpace:
    """The free space that is stored on disk, else computed and stored. A full or read-only disk is no error."""
    folders = (Path(module).parent for module in (__file__, worlds.__file__, robots.__file__))
    key = cache.content_key(cache.code_key(*folders), _description(robot), world.key)
    grid = CellGrid(overlap(world.bounds, world.terrain.extent))
    arrays = cache.load_arrays("free_space", key)
    if arrays is not None:
        bits = arrays.pop("bits")
        tensors = {name: torch.from_numpy(each) for name, each in arrays.items()}
        for k, name in enumerate(_CELLS):
            cells = bits & (1 << k) != 0
            tensors[name] = grid.centers(cells) if name.endswith("cells") else torch.from_numpy(cells)
        return FreeSpace(grid.cell, grid.origin, **tensors)
    space = _compute(world, robot, grid)
    arrays = {name: value.numpy() for name, value in space._tensors()}
    arrays["bits"] = bits = np.zeros(grid.shape, dtype=np.uint8)
    for k, name in enumerate(_CELLS):
        cells = arrays.pop(name)
        bits[cells_of(space, torch.from_numpy(cells)) if name.endswith("cells") else cells] |= np.uint8(1 << k)
    cache.store_arrays("free_space", key, arrays)
    return space


@lru_cache(maxsize=16)
def _description(robot: Robot) -> bytes:
    """The numbers of a robot, whatever its name."""
    return repr(replace(robot, name="")).encode()


def _compute(world: World, robot: Robot, grid: CellGrid) -> FreeSpace:
    most = robot.radius + LIDAR_CLEARANCES[0] + EXTRA_CLEARANCE
    clearance = clearance_on_grid(world.terrain, world.obstacles, grid.x, grid.y, most)
    room, gentle = clearance.numpy(), _gentle(world, robot, grid)
    areas = [grid.within(world.spawn_range, world.spawn_region), grid.within(world.goal_range, world.goal_region)]
    x, y = ((low + robot.radius, high - robot.radius) for low, high in grid.area)
    open_ground = gentle & grid.within((x, y))
    roomy, poses = open_ground & (room >= robot.radius + grid.half_diagonal), np.full(grid.shape, ALL_ORIENTATIONS)
    reached, narrow = passages.find_reach(robot, grid, room, gentle, roomy, areas)
    if not all((reached & area).any() for area in areas):
        # The rover turns at the centers of cells, but does not fit in all orientations wherever in a cell it is.
        roomy = open_ground & (room >= robot.radius + passages.MARGIN)
        poses = passages.fit_orientations(robot, grid, room, grid.half_diagonal)
        reached, narrow = passages.find_reach(robot, grid, room, gentle, roomy, areas)
    spawn, goal = (reached & area & (poses != 0) for area in areas)
    goal_cells, spawn_cells = grid.centers(goal), grid.centers(spawn)
    _check_any(world, robot, "goal", goal_cells)
    headings = _headings(world, robot, grid, clearance, spawn_cells) & passages.orientations_of_bins(poses[spawn])
    spawn_cells, headings = spawn_cells[headings != 0], headings[headings != 0]
    _check_any(world, robot, "spawn", spawn_cells)
    if not robot.drive.turns_in_place:
        spawn_cells, headings = _with_a_way_ahead(robot, grid, reached, spawn_cells, headings)
    narrow[roomy] = 0
    return FreeSpace(
        cell=grid.cell,
        origin=grid.origin,
        passable=torch.from_numpy(roomy | (narrow != 0)),
        roomy=torch.from_numpy(roomy),
        narrow_orientations=torch.from_numpy(narrow[narrow != 0].astype(np.int64)),
        spawn_cells=spawn_cells,
        spawn_headings=headings,
        goal_cells=goal_cells,
        goal_extremes=_extremes(world, goal_cells, spawn_cells, grid.cell),
    )


def _check_any(world: World, robot: Robot, kind: str, cells: Tensor) -> None:
    if len(cells) == 0:
        place = f"{kind}_range {getattr(world, f'{kind}_range')}"
        needs = f"{robot.name!r}, which needs a free disc of {robot.radius:g} m"
        raise ValueError(f"world {world.name!r} has no free {kind} cell for {needs}, in {place}")


def _extremes(world: World, goal_cells: Tensor, spawn_cells: Tensor, cell: float) -> Tensor:
    """Outermost goal cells in 16 directions: ``[16, 2]``, m."""
    extremes = goal_cells[(goal_cells @ ring(16).T).argmax(0)]
    # Every place is at least half as far from one of two points as these are from each other.
    if torch.cdist(extremes, extremes).max() >= 2 * (MIN_GOAL_DISTANCE + cell):
        return extremes
    farthest = torch.cdist(torch.cat((spawn_cells, goal_cells)), extremes).amax(1)
    if farthest.min() < MIN_GOAL_DISTANCE + cell:
        raise ValueError(
            f"the goal cells of world {world.name!r} lie so close together that from some places none is "
            f"{MIN_GOAL_DISTANCE} m away; goal_range is {world.goal_range}"
        )
    return extremes


def _gentle(world: World, robot: Robot, grid: CellGrid) -> np.ndarray:
    """Cells on gentle ground, with no cliff within the turning circle: bool ``[rows, columns]``.

    Strips and corners narrower than ``LANE_WIDTH`` do not count. No rover passes between cliffs through narrow cells,
    as wheels slip on slopes.
    """
    if world.terrain.is_flat:
        return np.ones(grid.shape, dtype=bool)
    slopes = ground.slopes_on_grid(world.terrain, grid)
    least = (robot.radius + grid.half_diagonal) / grid.cell
    away, _ = distance_to_cells(slopes > math.tan(ground.CLIFF_SLOPE), least + 1)
    gentle = (slopes <= math.tan(MAX_SLOPE)) & (away >= least)
    return binary_opening(gentle, np.ones([round(ground.LANE_WIDTH / grid.cell)] * 2))


def _headings(world: World, robot: Robot, grid: CellGrid, clearance: Tensor, cells: Tensor) -> Tensor:
    """Allowed heading bins of spawn cells with centers ``cells [S, 2]``, as bits of int64: ``[S]``.

    A bin is allowed if its two end headings are. The margins cover all headings in between and the whole cell.
    """
    yaws = torch.from_numpy(passages.headings_of_bins())
    ahead, left, _ = robot.lidar_position
    margin = grid.half_diagonal + math.hypot(ahead, left) * math.pi / HEADINGS + TILT_MARGIN
    if world.terrain.is_flat:
        offsets = torch.stack((ahead * yaws[:, 0] - left * yaws[:, 1], ahead * yaws[:, 1] + left * yaws[:, 0]), -1)
        chunks = [(cells, torch.tensor([-1]), offsets[None])]
    else:
        parts = cells.split(CHUNK)
        chunks = [(part, *ground.rest_headings(world.terrain, robot, grid, part, yaws)) for part in parts]
    for least in LIDAR_CLEARANCES:
        headings = torch.cat([_clear_headings(grid, clearance, least + margin, *chunk) for chunk in chunks])
        if headings.any():
            break
    return headings


def _with_a_way_ahead(
    robot: Robot, grid: CellGrid, reached: np.ndarray, cells: Tensor, headings: Tensor
) -> tuple[Tensor, Tensor]:
    """Spawn cells and headings of a robot that cannot turn away from what it faces.

    In a heading that counts, ``reached`` cells lie straight ahead for the radius of its sharpest turn. If there is none
    in the whole world, all stay.
    """
    ahead = torch.zeros_like(headings)
    steps = np.arange(1, 2 + math.ceil(robot.drive.min_radius(robot.wheels) / grid.cell))
    margin, (rows, columns), at = steps[-1] + 1, reached.shape, cells_of(grid, cells)
    free = np.pad(reached, margin)
    for number in range(HEADINGS):
        yaw = (number + 0.5) * 2 * math.pi / HEADINGS - math.pi
        # From the center of any cell, the same number of cells up and to the side.
        way = np.unique(np.floor(0.5 + steps[:, None] * np.array((math.sin(yaw), math.cos(yaw)))).astype(int), axis=0)
        clear = np.ones(reached.shape, bool)
        for up, aside in margin + way:
            clear &= free[up : up + rows, aside : aside + columns]
        ahead |= torch.from_numpy(clear)[at].long() << number
    kept = headings & ahead
    return (cells[kept != 0], kept[kept != 0]) if kept.any() else (cells, headings)


def _clear_headings(
    grid: CellGrid, clearance: Tensor, least: float, cells: Tensor, rests: Tensor, offsets: Tensor
) -> Tensor:
    """Heading bins of ``cells [S, 2]`` in which the lidar is ``least`` (m) from obstacles: ``[S]``.

    The headings in which the rover ``rests``, and ``offsets`` of the lidar there, are of each cell or of all.
    """
    headings = torch.zeros(len(cells), dtype=torch.int64)
    field = [clearance.numpy(), wp.vec2d(*grid.origin), grid.cell, least]
    inputs = [cells.numpy(), offsets.numpy(), rests.numpy().view(np.uint64), *field, headings.numpy()]
    wp.launch(find_headings, dim=len(cells), inputs=inputs, device="cpu")
    return headings
