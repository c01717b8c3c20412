"""What the obstacles of a world enclose: the interior of a building, and its rooms.

A disc that comes from outside rolls over all ground that it reaches without touching an obstacle. What it cannot cover
is enclosed: a doorway that is narrower than the disc keeps it out. The same holds for a disc in the yard around a
building: what it cannot cover from there is the building's interior.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import (
    binary_dilation,
    binary_fill_holes,
    distance_transform_edt,
    find_objects,
    generate_binary_structure,
    grey_dilation,
    label,
)

from rover_rl.worlds.clearance import Site, clearance_on_grid
from rover_rl.worlds.region import Area, Region, expanded

CELL = 0.1
"""Smallest side length of a cell, m."""
MAX_CELLS = 1_000_000
CLEARANCE = 0.35
"""Distance from obstacles that a rover's center keeps, m."""
PASSAGE = 0.3
"""Half the width of the narrowest passage that joins two rooms, m."""
DOORS = (0.35, 0.5, 0.65, 0.8)
"""Radii of discs that usual doorways keep out, m."""
GATES = (1.0, 1.3, 1.6, 2.0)
"""Radii of discs that gates keep out, m. They count if smaller ones find nothing."""
MOST_FOUND = 0.7
"""Share of the largest interior that a smaller disc must find to be preferred: it leaves out niches of the outside."""
SILL = 0.3
"""Width of the ground inside of a doorway that is not taken, m."""
LEAST_AREA = 4.0
"""Least free area of an interior, m^2."""
LEAST_SHARE = 0.05
"""Least free area of an interior as a share of the ground around it."""
YARD_SHARE = 0.15
"""Least free area of a small building in a yard as a share of the yard: a smaller one is a cabin in a hall."""
BUILDING = 20.0
"""Free area from which a building is not small, and counts whatever its share if it has a doorway, m^2."""
MOST_OPEN = 0.35
"""Largest share of an interior's outline that is open."""
MAIN_SHARE = 0.4
"""Least share of the interiors in a yard that the largest has: rooms around a corridor are no buildings in a yard."""
YARD_WIDTH = 1.25
"""Half the least width of a yard: what is narrower everywhere is a corridor around rooms, m."""


class Enclosure(NamedTuple):
    """An enclosed part of a site: its ground up to the obstacles, and the area for the center of a rover, m^2."""

    region: Region
    area: float
    in_yard: bool = False


class _Found(NamedTuple):
    """An interior: its cells, the cells that the disc covers around it, and its free area in m^2."""

    cells: np.ndarray
    around: np.ndarray
    area: float


class Enclosures:
    """Distances to the obstacles of a world on a grid, from which interiors and rooms are found."""

    def __init__(self, site: Site, known: Callable[[np.ndarray], np.ndarray] | None = None) -> None:
        outlines = [obstacle.footprint.numpy() for obstacle in site.obstacles] or [np.array(site.terrain.extent).T]
        low, high = np.concatenate(outlines).min(0), np.concatenate(outlines).max(0)
        self.box: Area = (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))
        # Around everything, there is room for the largest disc.
        self._x, self._y = grid_axes(expanded(self.box, GATES[-1] + 0.5))
        self._cell = float(self._x[1] - self._x[0])
        self._room = clearance_on_grid(site, self._x, self._y, GATES[-1] + self._cell).numpy()
        centers = np.stack(np.meshgrid(self._x, self._y), -1)
        self._known = np.ones(self._room.shape, dtype=bool) if known is None else known(centers)
        (left, right), (bottom, top) = site.terrain.extent
        on_ground = (centers >= (left, bottom)).all(-1) & (centers <= (right, top)).all(-1)
        # A wall that is thinner than a cell blocks a path of cells with common sides.
        self._free = (self._room > 0.51 * self._cell) & self._known & on_ground
        self._clear = (self._room >= PASSAGE) & self._free

    def interior(self) -> Enclosure | None:
        """Returns the interior of the largest building. ``None`` if the obstacles enclose nothing."""
        found = self._outermost(DOORS) or self._outermost(GATES)
        if found is None:
            return None
        inner, in_yard = self._within(found), False
        while inner is not None:
            found, in_yard = inner, True
            inner = self._within(found)
        return self._enclosure(found, in_yard)

    def room(self, x: float, y: float) -> Enclosure:
        """Returns the room that contains a point: its ground up to the doorways. Raises a ``ValueError`` outside."""
        (left, bottom), cell = corner_of(self._x, self._y), self._cell
        row, column = math.floor((y - bottom) / cell), math.floor((x - left) / cell)
        outside = ValueError(f"the point ({x:g}, {y:g}) lies outside: no obstacles enclose it")
        if not (0 <= row < len(self._y) and 0 <= column < len(self._x)):
            raise outside
        reach = _distance(~self._clear, cell)[row, column]
        if not self._free[row, column] or reach > CLEARANCE:
            raise ValueError(f"the point ({x:g}, {y:g}) lies in an obstacle, or too close to one")
        for radius in (*reversed(DOORS), *GATES):
            parts, count = label(self._core(radius))
            near = _distance(parts == 0, cell)[row, column]
            # A narrow corridor is a room of its own, if a smaller disc fits into it and not through its doorways.
            if not count or (radius in DOORS and near >= max(radius, reach + cell)):
                continue
            found = self._around_core(parts, row, column)
            if found is not None:
                return self._enclosure(found)
        raise outside

    def _around_core(self, parts: np.ndarray, row: int, column: int) -> _Found | None:
        """Returns the room of a cell, around one of the cores ``parts``; ``None`` if the cell is outside."""
        rooms = self._grown(parts)
        number = rooms[row, column] or self._nearest(rooms, row, column)
        if np.isin(number, _at_border(parts)):
            return None
        inside = (rooms == number) & self._clear
        groups, _ = label(inside)
        mine = groups == self._nearest(groups, row, column)
        return _Found(mine, (rooms > 0) & (rooms != number), self._size(mine))

    def _grown(self, parts: np.ndarray) -> np.ndarray:
        """Returns the rooms that grow from cores, widest ground first, and so meet where doorways are narrowest."""
        rooms, cross = parts.copy(), generate_binary_structure(2, 1)
        for least in np.arange(self._room[parts > 0].min(), PASSAGE - self._cell, -self._cell):
            allowed = self._free & (self._room >= max(least, PASSAGE))
            while True:
                new = allowed & (rooms == 0) & binary_dilation(rooms > 0)
                if not new.any():
                    break
                rooms[new] = grey_dilation(rooms, footprint=cross)[new]
        return rooms

    def _nearest(self, numbers: np.ndarray, row: int, column: int) -> int:
        """Returns the number other than 0 that is nearest to a cell."""
        rows, columns = np.nonzero(numbers)
        nearest = np.hypot(rows - row, columns - column).argmin()
        return int(numbers[rows[nearest], columns[nearest]])

    def _core(self, radius: float) -> np.ndarray:
        """Returns the cells in which the center of a disc may be."""
        return (self._room >= max(radius, 1.5 * self._cell)) & self._known

    def _covered(self, core: np.ndarray, radius: float) -> np.ndarray:
        """Returns the cells that a disc covers whose center is in ``core``."""
        return _distance(~core, self._cell) < max(radius, 1.5 * self._cell) - 1e-6

    def _size(self, cells: np.ndarray) -> float:
        """Returns the area of the cells in which the center of a rover may be, m^2."""
        return float((cells & (self._room >= CLEARANCE)).sum()) * self._cell**2

    def _outermost(self, radii: tuple[float, ...]) -> _Found | None:
        """Returns what a disc from outside of all obstacles cannot cover."""
        (x_low, x_high), (y_low, y_high) = self.box
        whole = (x_high - x_low) * (y_high - y_low)

        def covers() -> Iterator[tuple[np.ndarray, np.ndarray]]:
            for radius in radii:
                parts, _ = label(self._core(radius))
                around = self._covered(np.isin(parts, _at_border(parts)), radius)
                yield around, self._clear & ~around

        return self._best(covers(), lambda found: self._counts(found, whole))

    def _within(self, outer: _Found) -> _Found | None:
        """Returns the building in a yard, if ``outer`` is a yard around one."""

        def covers() -> Iterator[tuple[np.ndarray, np.ndarray]]:
            for radius in DOORS:
                yard = self._yard(outer, radius)
                if yard is not None:
                    around = self._covered(yard, radius)
                    hull = binary_fill_holes(around)
                    inner = self._clear & hull & ~around
                    if self._size(outer.cells & ~hull) <= self._size(inner):
                        yield around, inner

        def accepted(found: _Found) -> bool:
            inner = self._clear & binary_fill_holes(found.around) & ~found.around
            yard = self._size(outer.cells & found.around)
            large = found.area >= BUILDING or found.area >= YARD_SHARE * yard
            return large and found.area >= MAIN_SHARE * self._size(inner) and self._counts(found, yard)

        return self._best(covers(), accepted)

    def _yard(self, outer: _Found, radius: float) -> np.ndarray | None:
        """Returns where a disc may be around the other ground of ``outer``, if that is as wide as a yard."""
        parts, _ = label(self._core(radius) & outer.cells)
        boxes = [(rows.stop - rows.start) * (columns.stop - columns.start) for rows, columns in find_objects(parts)]
        if not boxes:
            return None
        yard = parts == 1 + int(np.argmax(boxes))
        return yard if self._room[yard].max() >= YARD_WIDTH else None

    def _counts(self, found: _Found, around: float) -> bool:
        """Returns whether an interior is large enough for the ground around it, ``around`` (m^2), and mostly shut."""
        opened, walls = self._mouth(found)
        enough = found.area >= LEAST_SHARE * around or (opened > 0 and found.area >= BUILDING)
        return found.area >= LEAST_AREA and enough and opened <= MOST_OPEN * (opened + walls)

    def _mouth(self, found: _Found) -> tuple[int, int]:
        """Returns how many cells of the outline around an interior are open, and how many are walls."""
        shells, _ = label(~found.around)
        row, column = np.argwhere(found.cells)[0]
        edge = (shells == shells[row, column]) & binary_dilation(found.around)
        walls = edge & ((self._room < self._cell) | ~self._known)
        return int(edge.sum() - walls.sum()), int(walls.sum())

    def _best(
        self, covers: Iterator[tuple[np.ndarray, np.ndarray]], accepted: Callable[[_Found], bool]
    ) -> _Found | None:
        """Returns the interior of the smallest disc that finds most of what any finds, of those that are accepted."""
        found = []
        for around, free in covers:
            cells = largest(label(free)[0], self._room >= CLEARANCE)
            if cells is not None:
                found.append(_Found(cells, around, self._size(cells)))
        found = [each for each in found if accepted(each)]
        most = max((each.area for each in found), default=0.0)
        return next((each for each in found if each.area >= MOST_FOUND * most), None)

    def _enclosure(self, found: _Found, in_yard: bool = False) -> Enclosure:
        """Returns an interior up to the obstacles, and not beyond its doorways."""
        sill, steps = max(1, round(SILL / self._cell)), round(PASSAGE / self._cell) + 2
        beyond = binary_dilation(found.around & self._free, mask=self._free, iterations=sill)
        allowed = self._free & ~beyond
        cells = binary_dilation(found.cells & allowed, mask=allowed, iterations=steps)
        return Enclosure(region_of(cells, self._x, self._y), self._size(cells), in_yard)


def largest(parts: np.ndarray, counted: np.ndarray | None = None) -> np.ndarray | None:
    """Returns the cells of the numbered part with most cells that count. ``None`` if there are none."""
    sizes = np.bincount((parts if counted is None else parts[counted]).ravel(), minlength=2)
    sizes[0] = 0
    return parts == sizes.argmax() if sizes.any() else None


def grid_axes(area: Area) -> tuple[np.ndarray, np.ndarray]:
    """Returns x of the columns and y of the rows of a grid over an area of at least two cells a side, m."""
    (x_low, x_high), (y_low, y_high) = area
    cell = max(CELL, math.sqrt((x_high - x_low) * (y_high - y_low) / MAX_CELLS))
    x, y = (low + cell * (np.arange(math.ceil((high - low) / cell)) + 0.5) for low, high in area)
    return x, y


def corner_of(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Returns the lower left corner of a grid whose cells have their centers at ``x`` and ``y``, m."""
    half = float(x[1] - x[0]) / 2
    return float(x[0]) - half, float(y[0]) - half


def region_of(cells: np.ndarray, x: np.ndarray, y: np.ndarray) -> Region:
    """Returns cells of a grid, bool ``[rows, columns]``, as a region."""
    return Region(torch.from_numpy(cells), float(x[1] - x[0]), corner_of(x, y))


def _distance(cells: np.ndarray, cell: float) -> np.ndarray:
    """Returns the distance of each true cell from the nearest false one, infinite if there is none, m."""
    return np.full(cells.shape, np.inf) if cells.all() else distance_transform_edt(cells) * cell


def _at_border(parts: np.ndarray) -> np.ndarray:
    """Returns the numbers of the parts at the border of the grid."""
    numbers = np.unique(np.concatenate((parts[0], parts[-1], parts[:, 0], parts[:, -1])))
    return numbers[numbers > 0]
