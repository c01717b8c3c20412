"""Elevation models: GeoTIFF, pictures, and NumPy arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rover_rl.option_names import written
from rover_rl.sims.worlds.files.contents import Contents, Grid
from rover_rl.sims.worlds.files.images import read_elevations
from rover_rl.sims.worlds.files.options import MAX_SIZE, ImportOptions

FAR = 1000.0
"""Distance from the origin beyond which a georeferenced grid is moved to the origin, m."""


def read_elevation(path: Path, options: ImportOptions) -> Contents:
    """Reads an elevation model. The first row is in the north, at the largest y.

    A GeoTIFF has its own spacing and position; if it is far away (in UTM coordinates, for example), its middle is moved
    to the origin. Other files need ``pixel``, and are centered. With ``height``, integers are scaled so that white is
    that high, and numbers of a float file are multiplied by it.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file cannot be read, or its scale is missing.
    """
    found = read_elevations(path)
    cell = (options.pixel, options.pixel) if options.pixel else found.cell
    if cell is None:
        pixel = written("pixel")
        raise ValueError(f"{path.name} does not say how large it is; give {pixel}, the size of a pixel in meters")
    if found.white != 1.0 and options.height is None:
        height = written("height")
        raise ValueError(f"{path.name} does not say how high it is; give {height}, the elevation of white in meters")
    contents = Contents(path.name.partition(".")[0])
    values = found.values[::-1] / found.white * (1.0 if options.height is None else options.height)
    rows, columns = values.shape
    width, depth = (columns - 1) * cell[0], (rows - 1) * cell[1]
    if max(width, depth, np.nanmax(np.abs(values))) > MAX_SIZE:
        raise ValueError(
            f"{path.name} spans {width:.3g} x {depth:.3g} m with heights up to {np.nanmax(np.abs(values)):.3g} m; at "
            f"most {MAX_SIZE:g} m are supported, so check {written('pixel')} and {written('height')}"
        )
    origin = (-width / 2, -depth / 2)
    if found.corner is not None and not options.pixel:
        west, south = found.corner[0], found.corner[1] - depth
        if max(abs(west), abs(west + width), abs(south), abs(south + depth)) <= FAR:
            origin = (west, south)
        else:
            middle = west + width / 2, south + depth / 2
            contents.notes.append(
                f"ground: the middle of the map, ({middle[0]:.2f}, {middle[1]:.2f}), is at the origin"
            )
    contents.grids.append(Grid(values, cell, origin))
    return contents
