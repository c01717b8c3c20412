"""Automatic areas of an imported world: spawn area, goal area, and bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.ndimage import label

from rover_rl.sims.worlds.files.options import ImportOptions
from rover_rl.sims.worlds.obstacles import Obstacle
from rover_rl.sims.worlds.terrain import Terrain

if TYPE_CHECKING:
    from rover_rl.sims.worlds.world import Area

CLEARANCE = 0.35
"""Distance from obstacles that a rover's center keeps, m."""
REACH = 0.5
"""Largest height above the ground at which obstacles are in the way, m."""
MAX_SLOPE = math.radians(25)
"""Largest slope on which a rover starts, rad."""
CELL = 0.1
"""Smallest side length of a cell, m."""
MAX_CELLS = 1_000_000
"""Largest number of cells."""
OPEN_SIDE = 20.0
"""Largest side of the spawn area without an enclosure, m."""
MARGIN = 1.0
"""Width between the areas and the bounds, or the end of the ground, m."""
LEAST_ENCLOSED = 4.0
"""Least area of an enclosure, m^2."""
ENCLOSED_SHARE = 0.25
"""Least share of the obstacles' bounding rectangle that an enclosure covers."""


@dataclass(frozen=True)
class Areas:
    """Areas of a world.

    Args:
        spawn_range: area in which episodes start.
        goal_range: area of the goals.
        bounds: area whose exit ends the episode.
        note: how the spawn area was found. Empty if it was given.
    """

    spawn_range: Area
    goal_range: Area
    bounds: Area
    note: str = ""


def find_areas(
    terrain: Terrain,
    obstacles: list[Obstacle],
    options: ImportOptions,
    limits: Area,
    known: np.ndarray | None = None,
) -> Areas:
    """Returns the areas that the options give, and automatic ones otherwise.

    An area without an exit between the obstacles, such as the interior of a building, is the spawn area, if it covers
    at least a quarter of the obstacles' bounding rectangle. Otherwise, the spawn area is a square of at most 20 m in
    the middle of the obstacles.

    Args:
        terrain: ground of the world.
        obstacles: obstacles of the world.
        options: options with areas.
        limits: area that has ground or obstacles.
        known: points ``[P, 2]`` of which at least one must be in a cell of the spawn area (m), such as the known cells
            of a map. ``None``: no such condition.

    Raises:
        ValueError: if there is no free ground in the areas.
    """
    solid = [obstacle for obstacle in obstacles if _in_the_way(terrain, obstacle)]
    automatic = _enclosed(solid, limits, known)
    if automatic is not None:
        spawn, bounds = automatic, _overlap(_grown(automatic, MARGIN), terrain.extent)
        note = "areas: the interior that the obstacles enclose"
    else:
        spawn, bounds = _open(terrain, solid, limits)
        note = "areas: the middle of the open ground"
    spawn_range = options.spawn_range or (spawn if options.bounds is None else _overlap(spawn, options.bounds))
    goal_range = options.goal_range or spawn_range
    if options.bounds is None:
        bounds = _union(bounds, _overlap(_grown(_union(spawn_range, goal_range), MARGIN), terrain.extent))
    areas = Areas(spawn_range, goal_range, options.bounds or bounds, "" if options.spawn_range else note)
    for name, area in (("spawn_range", areas.spawn_range), ("goal_range", areas.goal_range)):
        _check_free(terrain, solid, name, area)
    return areas


def _in_the_way(terrain: Terrain, obstacle: Obstacle) -> bool:
    """Returns whether a part of an obstacle may be at a rover's height."""
    vertices = obstacle.vertices
    ground = terrain.height_at(vertices[:, :2])
    return bool(vertices[:, 2].min() <= ground.max() + REACH and vertices[:, 2].max() >= ground.min())


class _Cells:
    """Cells of an area, and which of them obstacles block.

    Args:
        area: area to cover.
        obstacles: obstacles in the way.
    """

    def __init__(self, area: Area, obstacles: list[Obstacle]) -> None:
        (x_low, x_high), (y_low, y_high) = area
        self.cell = max(CELL, math.sqrt((x_high - x_low) * (y_high - y_low) / MAX_CELLS))
        self.x, self.y = (self._axis(*ends) for ends in area)
        self.blocked = np.zeros((len(self.y), len(self.x)), dtype=bool)
        for obstacle in obstacles:
            self._block(obstacle.footprint.numpy())

    def _axis(self, low: float, high: float) -> np.ndarray:
        """Returns the centers of the cells along an axis, with equal margins at both ends."""
        count = max(1, int((high - low) / self.cell))
        return (low + high) / 2 + self.cell * (np.arange(count) - (count - 1) / 2)

    def _block(self, outline: np.ndarray) -> None:
        """Blocks the cells whose centers are within the clearance of the sides of a convex polygon."""
        low, high = outline.min(0) - CLEARANCE, outline.max(0) + CLEARANCE
        rows, columns = (slice(*np.searchsorted(axis, (low[k], high[k]))) for k, axis in ((1, self.y), (0, self.x)))
        x, y = np.meshgrid(self.x[columns], self.y[rows])
        inside = np.ones(x.shape, dtype=bool)
        for (ax, ay), (bx, by) in zip(outline, np.roll(outline, -1, 0), strict=True):
            length = math.hypot(bx - ax, by - ay)
            inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) >= (1e-6 - CLEARANCE) * length
        self.blocked[rows, columns] |= inside


def _enclosed(obstacles: list[Obstacle], limits: Area, known: np.ndarray | None) -> Area | None:
    """Returns the bounding rectangle of the largest free part that obstacles enclose."""
    if not obstacles:
        return None
    corners = np.concatenate([obstacle.footprint.numpy() for obstacle in obstacles])
    box = (
        (float(corners[:, 0].min()), float(corners[:, 0].max())),
        (float(corners[:, 1].min()), float(corners[:, 1].max())),
    )
    cells = _Cells(_grown(box, 2 * CLEARANCE + 3 * CELL), obstacles)
    part, count = label(~cells.blocked)
    sizes = np.bincount(part.ravel(), minlength=count + 1)
    open_parts = np.unique(np.concatenate((part[0], part[-1], part[:, 0], part[:, -1])))
    sizes[0] = 0
    sizes[open_parts] = 0
    if known is not None:
        columns, rows = (np.searchsorted(axis, known[:, k]) for k, axis in enumerate((cells.x, cells.y)))
        inside = (columns < len(cells.x)) & (rows < len(cells.y))
        sizes[np.setdiff1d(np.arange(count + 1), part[rows[inside], columns[inside]])] = 0
    area = sizes.max() * cells.cell**2
    whole = (box[0][1] - box[0][0]) * (box[1][1] - box[1][0])
    if area < max(LEAST_ENCLOSED, ENCLOSED_SHARE * whole):
        return None
    rows, columns = np.nonzero(part == sizes.argmax())
    half = cells.cell / 2 + CLEARANCE
    x, y = cells.x[columns], cells.y[rows]
    found = (float(x.min()) - half, float(x.max()) + half), (float(y.min()) - half, float(y.max()) + half)
    return _overlap(found, limits)


def _open(terrain: Terrain, obstacles: list[Obstacle], limits: Area) -> tuple[Area, Area]:
    """Returns the spawn area and the bounds of a world without an enclosure."""
    bounds = _overlap(limits, terrain.extent)
    corners = [obstacle.footprint.numpy() for obstacle in obstacles]
    if corners:
        low, high = np.concatenate(corners).min(0) - 2 * MARGIN, np.concatenate(corners).max(0) + 2 * MARGIN
        box = (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))
    else:
        box = bounds
    within = _overlap(_shrunk(bounds, MARGIN), box)
    if any(high <= low for low, high in within):
        within = _shrunk(bounds, MARGIN)
    spawn = tuple(_middle(low, high) for low, high in within)
    return (spawn[0], spawn[1]), _overlap(_union(bounds, _grown((spawn[0], spawn[1]), MARGIN)), terrain.extent)


def _middle(low: float, high: float) -> tuple[float, float]:
    """Returns the middle of a range, at most :data:`OPEN_SIDE` long."""
    middle, half = (low + high) / 2, min(high - low, OPEN_SIDE) / 2
    return middle - half, middle + half


def _check_free(terrain: Terrain, obstacles: list[Obstacle], name: str, area: Area) -> None:
    """Checks that a rover finds a place in an area."""
    common = _overlap(area, terrain.extent)
    if any(high - low < 2 * CLEARANCE for low, high in common):
        raise ValueError(f"the world has no free ground in {name} {_text(area)}: its ground is {_text(terrain.extent)}")
    cells = _Cells(common, obstacles)
    centers = torch.from_numpy(np.stack(np.meshgrid(cells.x, cells.y), -1))
    gentle = terrain.normal_at(centers)[..., 2].numpy() >= math.cos(MAX_SLOPE)
    if not (gentle & ~cells.blocked).any():
        raise ValueError(
            f"the world has no free ground in {name} {_text(area)}: it is covered by obstacles or too steep"
        )


def _text(area: Area) -> str:
    return ", ".join(f"{axis} {low:.1f} to {high:.1f} m" for axis, (low, high) in zip("xy", area, strict=True))


def _grown(area: Area, margin: float) -> Area:
    (x_low, x_high), (y_low, y_high) = area
    return (x_low - margin, x_high + margin), (y_low - margin, y_high + margin)


def _shrunk(area: Area, margin: float) -> Area:
    """Returns an area less a margin, or less a quarter of its sides if those are short."""
    x, y = ((low + m, high - m) for low, high in area for m in (min(margin, (high - low) / 4),))
    return x, y


def _overlap(a: Area, b: Area) -> Area:
    x, y = ((max(p[0], q[0]), min(p[1], q[1])) for p, q in zip(a, b, strict=True))
    return x, y


def _union(a: Area, b: Area) -> Area:
    x, y = ((min(p[0], q[0]), max(p[1], q[1])) for p, q in zip(a, b, strict=True))
    return x, y
