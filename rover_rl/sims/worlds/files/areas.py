"""Areas of an imported world: spawn area, goal area, and bounds, given or found."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.ndimage import label

from rover_rl.option_names import written
from rover_rl.sims.worlds.clearance import Site, clearance_on_grid
from rover_rl.sims.worlds.files.enclosure import CLEARANCE, Enclosure, FloorPlan, grid_axes
from rover_rl.sims.worlds.files.options import ImportOptions
from rover_rl.sims.worlds.obstacles import Obstacle
from rover_rl.sims.worlds.region import Area, Region, expanded, overlap, union
from rover_rl.sims.worlds.terrain import MAX_SLOPE, Terrain

OPEN_SIDE = 20.0
"""Largest side of the spawn area without an enclosure, m."""
MARGIN = 1.0
"""Width between the areas and the bounds, or the end of the ground, m."""


@dataclass(frozen=True)
class Areas:
    """Areas of a world, named as the arguments of :class:`rover_rl.World`.

    Args:
        spawn_range: area in which episodes start.
        goal_range: area of the goals.
        bounds: area whose exit ends the episode.
        spawn_region: part of ``spawn_range`` in which episodes start. ``None``: all of it.
        goal_region: part of ``goal_range`` with the goals. ``None``: all of it.
    """

    spawn_range: Area
    goal_range: Area
    bounds: Area
    spawn_region: Region | None = None
    goal_region: Region | None = None


def find_areas(
    terrain: Terrain,
    obstacles: list[Obstacle],
    options: ImportOptions,
    limits: Area,
    known: Callable[[np.ndarray], np.ndarray] | None = None,
) -> tuple[Areas, list[str]]:
    """Returns the areas that the options give, and automatic ones otherwise, with notes on how they were found.

    The ground that obstacles enclose, such as the interior of a building, is the spawn area. If they enclose none, it
    is a square of at most 20 m in the middle of the obstacles. A point in the place of an area is the room around it.

    Args:
        terrain: ground of the world.
        obstacles: obstacles of the world.
        options: options with areas.
        limits: area that has ground or obstacles.
        known: function of points ``[..., 2]`` (m) that returns which of them a map knows. ``None``: all.

    Raises:
        ValueError: if there is no free ground in the areas, or a point is not in a room.
    """
    return _Finder(terrain, obstacles, options, limits, known).areas()


class _Finder:
    """Finds the areas of a world. See :func:`find_areas`."""

    def __init__(
        self,
        terrain: Terrain,
        obstacles: list[Obstacle],
        options: ImportOptions,
        limits: Area,
        known: Callable[[np.ndarray], np.ndarray] | None,
    ) -> None:
        self._terrain, self._options, self._limits, self._known = terrain, options, limits, known
        self._site = Site(terrain, obstacles)
        self._notes: list[str] = []

    @cached_property
    def _plan(self) -> FloorPlan:
        return FloorPlan(self._site, self._known)

    def areas(self) -> tuple[Areas, list[str]]:
        """Returns the areas and the notes."""
        options, extent = self._options, self._terrain.extent
        automatic, around, note = self._automatic()
        spawn = self._given("spawn_range") or automatic
        goal = self._given("goal_range") or spawn
        bounds = options.bounds or union(around, overlap(expanded(union(spawn[0], goal[0]), MARGIN), extent))
        (spawn_range, spawn_region), (goal_range, goal_region) = (
            self._checked(name, overlap(area, bounds) if region or area is automatic[0] else area, region)
            for name, (area, region) in (("spawn_range", spawn), ("goal_range", goal))
        )
        notes = self._notes if options.spawn_range is not None else [note, *self._notes]
        return Areas(spawn_range, goal_range, bounds, spawn_region, goal_region), notes

    def _given(self, name: str) -> tuple[Area, Region | None] | None:
        """Returns the area that an option gives: a rectangle, and a region in it if it is a polygon or a point."""
        place = getattr(self._options, name)
        if place is None:
            return None
        if isinstance(place[0], float):
            found = self._plan.room(*place)
            what = name.partition("_")[0]
            self._notes.append(f"{what} area: the room around ({place[0]:g}, {place[1]:g}){_size(found)}")
            return found.region.bounds, found.region
        if len(place) == 2:
            return place, None
        region = Region.polygon(place)
        return region.bounds, region

    def _automatic(self) -> tuple[tuple[Area, Region | None], Area, str]:
        """Returns the automatic spawn area with its region, an area that the bounds cover, and a note."""
        found = self._plan.interior() if self._site.obstacles else None
        if found is not None:
            area = found.region.bounds
            where = ", in the middle of an enclosed yard" if found.in_yard else ""
            note = f"areas: the interior that the obstacles enclose{where}{_size(found)}"
            return (area, found.region), overlap(expanded(area, MARGIN), self._terrain.extent), note
        spawn, bounds = self._open()
        return (spawn, self._known_part(spawn)), bounds, "areas: the middle of the open ground"

    def _open(self) -> tuple[Area, Area]:
        """Returns the spawn area and the bounds of a world without an enclosure."""
        bounds = overlap(self._limits, self._terrain.extent)
        box = expanded(self._plan.box, 2 * MARGIN) if self._site.obstacles else bounds
        within = overlap(_shrunk(bounds, MARGIN), box)
        if any(high <= low for low, high in within):
            within = _shrunk(bounds, MARGIN)
        spawn = _middle(*within[0]), _middle(*within[1])
        return spawn, overlap(union(bounds, expanded(spawn, MARGIN)), self._terrain.extent)

    def _known_part(self, area: Area) -> Region | None:
        """Returns the largest connected part of an area that a map knows."""
        if self._known is None:
            return None
        x, y = grid_axes(area)
        parts, _ = label(self._known(np.stack(np.meshgrid(x, y), -1)))
        sizes = np.bincount(parts.ravel())
        sizes[0] = 0
        cell = float(x[1] - x[0])
        corner = float(x[0]) - cell / 2, float(y[0]) - cell / 2
        return Region(torch.from_numpy(parts == sizes.argmax()), cell, corner) if sizes.any() else None

    def _checked(self, name: str, area: Area, region: Region | None) -> tuple[Area, Region | None]:
        """Returns an area and its region, after checking that a rover finds a place in it."""
        terrain = self._terrain
        common = overlap(area, terrain.extent)
        none = f"the world has no free ground in {written(name)} {_text(area)}:"
        if any(high - low < 2 * CLEARANCE for low, high in common):
            raise ValueError(f"{none} its ground is {_text(terrain.extent)}")
        x, y = grid_axes(common)
        centers = torch.from_numpy(np.stack(np.meshgrid(x, y), -1))
        free = centers[clearance_on_grid(self._site, x, y, 2 * CLEARANCE) >= CLEARANCE]
        if region is not None:
            free = free[region.contains(free)]
        if not bool((terrain.normal_at(free)[..., 2] >= math.cos(MAX_SLOPE)).any()):
            raise ValueError(f"{none} it is covered by obstacles or too steep")
        return area, region


def _middle(low: float, high: float) -> tuple[float, float]:
    """Returns the middle of a range, at most :data:`OPEN_SIDE` long."""
    middle, half = (low + high) / 2, min(high - low, OPEN_SIDE) / 2
    return middle - half, middle + half


def _size(found: Enclosure) -> str:
    return f", {found.area:.0f} m^2 of free ground"


def _text(area: Area) -> str:
    return ", ".join(f"{axis} {low:.1f} to {high:.1f} m" for axis, (low, high) in zip("xy", area, strict=True))


def _shrunk(area: Area, margin: float) -> Area:
    """Returns an area less a margin, or less a quarter of its sides if those are short."""
    x, y = ((low + m, high - m) for low, high in area for m in (min(margin, (high - low) / 4),))
    return x, y
