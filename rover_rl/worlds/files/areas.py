"""Areas of an imported world: spawn area, goal area, and bounds, given or found."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.ndimage import label

from rover_rl.option_names import written
from rover_rl.worlds.clearance import clearance_on_grid
from rover_rl.worlds.files.options import ImportOptions
from rover_rl.worlds.region import Area, Region, expanded, overlap, union
from rover_rl.worlds.solids import Solids
from rover_rl.worlds.terrain import MAX_SLOPE, Terrain

CELL, MAX_CELLS = 0.1, 1_000_000
"""Smallest side length of a cell, m, and largest number of cells."""
CLEARANCE = 0.35
"""Distance from obstacles that a rover's center keeps, m."""
LEAST_AREA = 4.0
"""Least size of free ground that is enclosed, m^2: a smaller one is the inside of a box."""
MARGIN = 1.0
"""Width between the areas and the bounds, or the end of the ground, m."""


def find_areas(
    terrain: Terrain,
    obstacles: Sequence[Solids],
    options: ImportOptions,
    limits: Area,
    known: Callable[[np.ndarray], np.ndarray] | None = None,
) -> tuple[dict[str, Any], list[str]]:
    """Returns the areas that the options give, and automatic ones otherwise, and notes on how they were found.

    Free ground is what the center of a rover reaches, in connected parts. The automatic area is the largest part of at
    least 4 m^2 that obstacles enclose, so that it does not touch the border of the site, else the largest part. A point
    in the place of an area is the part around it.

    ``limits`` is the area that has ground or obstacles, and ``known`` a function of points ``[..., 2]`` (m) that
    returns which of them a map knows; ``None``: all.
    """
    limits = overlap(limits, terrain.extent)
    notes: list[str] = []
    ground = _FreeGround.of(terrain, obstacles, limits, known)

    def place(name: str) -> tuple[Area, Region | None] | None:
        """Area that an option gives: a rectangle, and a region in it if it is a polygon or a point."""
        given = getattr(options, name)
        if given is None or (len(given) == 2 and not isinstance(given[0], float)):
            return given and (given, None)
        if len(given) > 2:
            region = Region.polygon(given)
        else:
            region = ground.around(*given)
            about = f"the free ground around ({given[0]:g}, {given[1]:g}), {region.area:.0f} m^2"
            notes.append(f"{name.partition('_')[0]} area: {about}")
        return region.bounds, region

    spawn, around = place("spawn_range"), limits
    if spawn is None:
        largest, is_enclosed = ground.largest()
        spawn = largest.bounds, largest
        notes.append(f"areas: {'enclosed' if is_enclosed else 'open'} ground, {largest.area:.0f} m^2 of it free")
        around = overlap(expanded(largest.bounds, MARGIN), terrain.extent) if is_enclosed else limits
    goal = place("goal_range") or spawn
    margin = overlap(expanded(union(spawn[0], goal[0]), MARGIN), terrain.extent)
    bounds = options.bounds or union(around, margin)
    areas: dict[str, Any] = {"bounds": bounds}
    for name, (area, region) in (("spawn", spawn), ("goal", goal)):
        area = overlap(area, bounds) if region else area
        _check(terrain, obstacles, f"{name}_range", area, region)
        areas |= {f"{name}_range": area, f"{name}_region": region}
    return areas, notes


class _FreeGround(NamedTuple):
    """Free cells of a grid by the numbers of their connected parts, 0 for others: ``[rows, columns]``."""

    parts: np.ndarray
    cell: float
    corner: tuple[float, float]
    centers: np.ndarray

    @classmethod
    def of(
        cls,
        terrain: Terrain,
        obstacles: Sequence[Solids],
        area: Area,
        known: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> _FreeGround:
        (x_low, x_high), (y_low, y_high) = area
        cell = max(CELL, math.sqrt(max(0.0, (x_high - x_low) * (y_high - y_low)) / MAX_CELLS))
        x, y = (low + cell * (np.arange(max(2, math.ceil((high - low) / cell))) + 0.5) for low, high in area)
        centers = np.stack(np.meshgrid(x, y), -1)
        free = clearance_on_grid(terrain, obstacles, x, y, 2 * CLEARANCE).numpy() >= CLEARANCE
        free &= terrain.normal_at(torch.from_numpy(centers))[..., 2].numpy() >= math.cos(MAX_SLOPE)
        if known is not None:
            free &= known(centers)
        cell = float(x[1] - x[0])
        return cls(label(free)[0], cell, (float(x[0]) - cell / 2, float(y[0]) - cell / 2), centers)

    def largest(self) -> tuple[Region, bool]:
        """Returns the part that episodes take place in, and whether it is enclosed."""
        sizes = np.bincount(self.parts.ravel())
        sizes[0] = 0
        if not sizes.any():
            raise ValueError("the world has no free ground: it is covered by obstacles or too steep")
        enclosed = sizes * self.cell**2 >= LEAST_AREA
        enclosed[np.concatenate((self.parts[[0, -1]].ravel(), self.parts[:, [0, -1]].ravel()))] = False
        chosen = int(np.where(enclosed, sizes, 0).argmax() if enclosed.any() else sizes.argmax())
        return self._region(chosen), bool(enclosed.any())

    def around(self, x: float, y: float) -> Region:
        """Returns the part at a point. Raises a ``ValueError`` if there is none."""
        column, row = (math.floor((at - low) / self.cell) for at, low in zip((x, y), self.corner, strict=True))
        inside = 0 <= row < len(self.parts) and 0 <= column < len(self.parts[0])
        if not inside or not self.parts[row, column]:
            where = "in an obstacle, too close to one, or on steep ground" if inside else "outside of the world"
            raise ValueError(f"the point ({x:g}, {y:g}) lies {where}")
        return self._region(int(self.parts[row, column]))

    def _region(self, part: int) -> Region:
        return Region(torch.from_numpy(self.parts == part), self.cell, self.corner)


def _check(terrain: Terrain, obstacles: Sequence[Solids], name: str, area: Area, region: Region | None) -> None:
    common = overlap(area, terrain.extent)
    none = f"the world has no free ground in {written(name)} {_text(area)}:"
    if any(high - low < 2 * CLEARANCE for low, high in common):
        raise ValueError(f"{none} its ground is {_text(terrain.extent)}")
    ground = _FreeGround.of(terrain, obstacles, common)
    centers = torch.from_numpy(ground.centers[ground.parts > 0])
    if not len(centers) or (region is not None and not region.contains(centers).any()):
        raise ValueError(f"{none} it is covered by obstacles or too steep")


def _text(area: Area) -> str:
    return ", ".join(f"{axis} {low:.1f} to {high:.1f} m" for axis, (low, high) in zip("xy", area, strict=True))
