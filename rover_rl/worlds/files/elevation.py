"""Elevation models: GeoTIFF, pictures, and NumPy arrays."""

from __future__ import annotations

import io
import logging
import math
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, UnidentifiedImageError

from rover_rl.option_names import written
from rover_rl.worlds.files import TIFF_SUFFIXES, optional
from rover_rl.worlds.files.contents import Contents, Grid
from rover_rl.worlds.files.geotiff import GeoTags, is_missing, read_tags
from rover_rl.worlds.files.options import MAX_SIZE, ImportOptions

MAX_PIXELS = 36_000_000
FAR = 1000.0
"""Distance from the origin beyond which a georeferenced grid is moved to the origin, m."""
# What tifffile says of odd tags is no news to users: they are read here.
logging.getLogger("tifffile").addHandler(logging.NullHandler())


class Elevations(NamedTuple):
    """Numbers of a picture or an array, with the first row first.

    Attributes:
        values: numbers ``[rows, columns]``, float64, NaN where there is no data.
        white: the largest number of unsigned integers, 1 for other types.
        tags: what a GeoTIFF says of them.
    """

    values: np.ndarray
    white: float
    tags: GeoTags | None = None


def read_elevation(path: Path, options: ImportOptions) -> Contents:
    """Reads an elevation model. The first row is in the north, at the largest y.

    A GeoTIFF has its own spacing, position and units; if it is far away (in UTM coordinates, for example), its middle
    is moved to the origin. Other files need ``pixel``, and are centered. With ``height``, unsigned integers are scaled
    so that white is that high, and other numbers are multiplied by it.
    """
    found, contents = read_elevations(path), Contents(path.name.partition(".")[0])
    tags, values = found.tags or GeoTags(1.0, 0.0), found.values
    pixel, height = written("pixel"), written("height")
    if tags.no_meters and not options.pixel:
        raise ValueError(f"{path.name} {tags.no_meters}, or give {pixel}, the size of a pixel in meters")
    cell = (options.pixel, options.pixel) if options.pixel else tags.cell
    if cell is None:
        raise ValueError(f"{path.name} does not say how large it is; give {pixel}, the size of a pixel in meters")
    if found.white != 1 and found.tags is None and options.height is None:
        raise ValueError(f"{path.name} does not say how high it is; give {height}, the elevation of white in meters")
    if found.white != 1 and options.height is not None:
        values = values / found.white * options.height
    else:
        values = (tags.scale * values + tags.offset) * (1.0 if options.height is None else options.height)
        contents.notes += tags.notes
    # Rows begin in the south, and columns in the west.
    values = np.ascontiguousarray(values[:: -1 if cell[1] > 0 else 1, :: 1 if cell[0] > 0 else -1])
    rows, columns = values.shape
    width, depth, highest = (columns - 1) * abs(cell[0]), (rows - 1) * abs(cell[1]), np.nanmax(np.abs(values))
    if max(width, depth, highest) > MAX_SIZE:
        raise ValueError(
            f"{path.name} spans {width:.3g} x {depth:.3g} m with heights up to {highest:.3g} m; at most {MAX_SIZE:g} m "
            f"are supported, so check {pixel} and {height}"
        )
    origin = (-width / 2, -depth / 2)
    if tags.corner is not None and not options.pixel:
        west, south = (
            tags.corner[0] + min(0.0, cell[0]) * (columns - 1),
            tags.corner[1] - max(0.0, cell[1]) * (rows - 1),
        )
        if max(abs(west), abs(west + width), abs(south), abs(south + depth)) <= FAR:
            origin = (west, south)
        else:
            middle = f"({west + width / 2:.2f}, {south + depth / 2:.2f})"
            contents.notes.append(f"ground: the middle of the map, {middle}, is at the origin")
    contents.grids.append(Grid(values, (abs(cell[0]), abs(cell[1])), origin))
    return contents


def read_elevations(path: Path) -> Elevations:
    """Reads a GeoTIFF, PNG, PGM or other gray picture, or a NumPy array."""
    suffix = path.suffix.lower()
    if suffix == ".npy":
        found = _read_array(path)
    elif suffix in TIFF_SUFFIXES:
        found = _read_tiff(path)
    else:
        gray, _ = read_picture(path)
        found = Elevations(gray.astype(float), white_of(gray))
    if found.values.ndim != 2 or min(found.values.shape) < 2:
        raise ValueError(f"{path} must hold a grid of at least 2 x 2 heights, got {found.values.shape}")
    if np.isinf(found.values).any() or not np.isfinite(found.values).any():
        raise ValueError(f"the heights in {path} must be finite numbers")
    return found


def white_of(values: np.ndarray) -> float:
    """Returns the largest number of unsigned integers, 1 for other types."""
    return float(np.iinfo(values.dtype).max) if values.dtype.kind == "u" else 1.0


def _check_pixels(path: Path, shape: tuple[int, ...]) -> None:
    if math.prod(shape) > MAX_PIXELS:
        size = " x ".join(map(str, shape))
        raise ValueError(f"{path} has {size} values; at most {MAX_PIXELS:,} are supported, so scale it down first")


def read_picture(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Reads a picture as gray values ``[rows, columns]``, and which of them are clear, if it has an alpha channel.

    Values are uint8 or uint16, or float32 of a picture of floats.
    """
    data = path.read_bytes()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data)) as image:
                _check_pixels(path, image.size)
                see_through = not image.mode.startswith("I") and image.has_transparency_data
                clear = np.asarray(image.convert("RGBA"))[..., 3] < 255 if see_through else None
                return _gray(image), clear
    except UnidentifiedImageError as error:
        raise ValueError(f"{path} is no picture that can be read") from error
    except Image.DecompressionBombError as error:
        raise ValueError(f"{path} has too many pixels; at most {MAX_PIXELS:,} are supported") from error
    except (OSError, SyntaxError, EOFError, OverflowError, MemoryError) as error:
        raise ValueError(f"{path} is a damaged picture: {error}") from error


def _gray(image: Image.Image) -> np.ndarray:
    if image.mode.startswith("I"):
        # Pillow reads 16 bit pictures as 16 or as 32 bit integers, depending on the version.
        return np.asarray(image).astype(np.uint16)
    if image.mode == "F":
        return np.asarray(image)
    if image.mode in ("L", "1"):
        return np.asarray(image.convert("L"))
    return np.asarray(image.convert("RGB")).mean(-1).round().astype(np.uint8)


def _read_array(path: Path) -> Elevations:
    try:
        # The memory map refuses a file that is shorter than its header says, and reads nothing before the checks.
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError, OverflowError) as error:
        raise ValueError(f"{path} is no array of numbers that can be read: {error}") from error
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "uif":
        raise ValueError(f"{path} must hold one array of numbers")
    _check_pixels(path, values.shape)
    return Elevations(np.array(values, dtype=float), white_of(values))


def _read_tiff(path: Path) -> Elevations:
    tifffile: Any = optional("tifffile")
    data = path.read_bytes()
    try:
        with tifffile.TiffFile(io.BytesIO(data)) as file:
            page = file.pages[0]
            _check_pixels(path, page.shape)
            tags = {tag.code: tag.value for tag in page.tags.values()}
            bands = np.moveaxis(page.asarray(), page.axes.index("S"), 0) if "S" in page.axes else [page.asarray()]
            values, meaning = bands[0], read_tags(path.name, tags)
            hidden = is_missing(values, tags)
            extra = zip(bands[::-1], page.extrasamples[::-1], strict=False)
            alphas = [band for band, kind in extra if kind in (1, 2)]
            for alpha in alphas:
                hidden |= alpha == 0
            for mask in file.pages[1:]:
                if mask.is_mask and mask.shape == values.shape:
                    hidden |= mask.asarray() == 0
    except ImportError:
        raise
    # The reader raises errors of all kinds for a damaged file.
    except Exception as error:
        if str(path) in str(error):
            raise
        if "imagecodecs" in str(error):
            optional("imagecodecs")
        helps = f"gdal_translate -co COMPRESS=DEFLATE {path.name} new.tif helps if GDAL can read it"
        raise ValueError(f"{path} is a TIFF that cannot be read: {str(error)[:200]}; {helps}") from error
    if values.ndim != 2 or values.dtype.kind not in "uif":
        raise ValueError(f"{path} must have bands of numbers, got shape {values.shape} of {values.dtype}")
    heights = values.astype(float)
    heights[hidden] = np.nan
    count = len(bands) - len(alphas)
    if meaning is not None and count > 1:
        meaning = meaning._replace(notes=(f"ground: the first of {count} bands", *meaning.notes))
    return Elevations(heights, white_of(values), meaning)
