"""Areas of an imported world: spawn area, goal area, and bounds, given or found."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.ndimage import label

from rover_rl.option_names import written
from rover_rl.worlds.clearance import Site, clearance_on_grid
from rover_rl.worlds.files.enclosure import CLEARANCE, Enclosures, grid_axes, largest, region_of
from rover_rl.worlds.files.options import ImportOptions
from rover_rl.worlds.region import Area, Region, expanded, overlap, union
from rover_rl.worlds.solids import Solids
from rover_rl.worlds.terrain import MAX_SLOPE, Terrain

OPEN_SIDE = 20.0
"""Largest side of the spawn area without an enclosure, m."""
MARGIN = 1.0
"""Width between the areas and the bounds, or the end of the ground, m."""


def find_areas(
    terrain: Terrain,
    obstacles: Sequence[Solids],
    options: ImportOptions,
    limits: Area,
    known: Callable[[np.ndarray], np.ndarray] | None = None,
) -> tuple[dict[str, Any], list[str]]:
    """Returns the areas that the options give, and automatic ones otherwise.

    The ground that obstacles enclose, such as the interior of a building, is the spawn area. If they enclose none, it
    is a square of at most 20 m in the middle of the obstacles. A point in the place of an area is the room around it.

    Args:
        terrain: ground of the world.
        obstacles: obstacles of the world.
        options: options with areas.
        limits: area that has ground or obstacles.
        known: function of points ``[..., 2]`` (m) that returns which of them a map knows. ``None``: all.

    Returns:
        Areas and regions, as arguments of :class:`rover_rl.World`, and notes on how they were found.
    """
    return _Finder(Site(terrain, obstacles), options, overlap(limits, terrain.extent), known).areas()


@dataclass
class _Finder:
    """Finds the areas of a world. See :func:`find_areas`."""

    site: Site
    options: ImportOptions
    limits: Area
    known: Callable[[np.ndarray], np.ndarray] | None
    notes: list[str] = field(default_factory=list)

    @cached_property
    def _enclosures(self) -> Enclosures:
        return Enclosures(self.site, self.known)

    def areas(self) -> tuple[dict[str, Any], list[str]]:
        """Returns the areas and the notes."""
        automatic, around, note = self._automatic()
        spawn = self._given("spawn_range") or automatic
        goal = self._given("goal_range") or spawn
        bounds = self.options.bounds or union(
            around, overlap(expanded(union(spawn[0], goal[0]), MARGIN), self.site.terrain.extent)
        )
        areas: dict[str, Any] = {"bounds": bounds}
        for name, (area, region) in (("spawn", spawn), ("goal", goal)):
            area = overlap(area, bounds) if region or area is automatic[0] else area
            self._check(f"{name}_range", area, region)
            areas |= {f"{name}_range": area, f"{name}_region": region}
        return areas, self.notes if self.options.spawn_range is not None else [note, *self.notes]

    def _given(self, name: str) -> tuple[Area, Region | None] | None:
        """Returns the area that an option gives: a rectangle, and a region in it if it is a polygon or a point."""
        place = getattr(self.options, name)
        if place is None:
            return None
        if isinstance(place[0], float):
            found = self._enclosures.room(*place)
            where = f"the room around ({place[0]:g}, {place[1]:g})"
            self.notes.append(f"{name.partition('_')[0]} area: {where}, {found.area:.0f} m^2 of free ground")
            return found.region.bounds, found.region
        if len(place) == 2:
            return place, None
        region = Region.polygon(place)
        return region.bounds, region

    def _automatic(self) -> tuple[tuple[Area, Region | None], Area, str]:
        """Returns the automatic spawn area with its region, an area that the bounds cover, and a note."""
        found = self._enclosures.interior() if self.site.obstacles else None
        if found is not None:
            area = found.region.bounds
            where = ", in the middle of an enclosed yard" if found.in_yard else ""
            note = f"areas: the interior that the obstacles enclose{where}, {found.area:.0f} m^2 of free ground"
            return (area, found.region), overlap(expanded(area, MARGIN), self.site.terrain.extent), note
        box = expanded(self._enclosures.box, 2 * MARGIN) if self.site.obstacles else self.limits
        within = overlap(_shrunk(self.limits), box)
        if any(high <= low for low, high in within):
            within = _shrunk(self.limits)
        spawn = _middle(*within[0]), _middle(*within[1])
        bounds = overlap(union(self.limits, expanded(spawn, MARGIN)), self.site.terrain.extent)
        return (spawn, self._known_part(spawn)), bounds, "areas: the middle of the open ground"

    def _known_part(self, area: Area) -> Region | None:
        """Returns the largest connected part of an area that a map knows."""
        if self.known is None:
            return None
        x, y = grid_axes(area)
        part = largest(label(self.known(np.stack(np.meshgrid(x, y), -1)))[0])
        return None if part is None else region_of(part, x, y)

    def _check(self, name: str, area: Area, region: Region | None) -> None:
        """Checks that a rover finds a place in an area."""
        terrain = self.site.terrain
        common = overlap(area, terrain.extent)
        none = f"the world has no free ground in {written(name)} {_text(area)}:"
        if any(high - low < 2 * CLEARANCE for low, high in common):
            raise ValueError(f"{none} its ground is {_text(terrain.extent)}")
        x, y = grid_axes(common)
        centers = torch.from_numpy(np.stack(np.meshgrid(x, y), -1))
        free = centers[clearance_on_grid(self.site, x, y, 2 * CLEARANCE) >= CLEARANCE]
        if region is not None:
            free = free[region.contains(free)]
        if not bool((terrain.normal_at(free)[..., 2] >= math.cos(MAX_SLOPE)).any()):
            raise ValueError(f"{none} it is covered by obstacles or too steep")


def _middle(low: float, high: float) -> tuple[float, float]:
    """Returns the middle of a range, at most :data:`OPEN_SIDE` long."""
    middle, half = (low + high) / 2, min(high - low, OPEN_SIDE) / 2
    return middle - half, middle + half


def _text(area: Area) -> str:
    return ", ".join(f"{axis} {low:.1f} to {high:.1f} m" for axis, (low, high) in zip("xy", area, strict=True))


def _shrunk(area: Area) -> Area:
    """Returns an area less a margin, or less a quarter of its sides if those are short."""
    x, y = ((low + m, high - m) for low, high in area for m in (min(MARGIN, (high - low) / 4),))
    return x, y
