"""Elevation models: GeoTIFF as GDAL reads it, pictures, and NumPy arrays."""

from __future__ import annotations

import io
import logging
import math
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, UnidentifiedImageError

from rover_rl.option_names import written
from rover_rl.tiny_xml import parse_xml, text_of
from rover_rl.worlds.files.contents import Contents, Grid
from rover_rl.worlds.files.options import MAX_SIZE, TIFF_SUFFIXES, ImportOptions, optional

MAX_PIXELS = 36_000_000
FAR = 1000.0
"""Distance from the origin beyond which a georeferenced grid is moved to the origin, m."""
PIXEL_SCALE, TIE_POINT, TRANSFORMATION, KEYS = 33550, 33922, 34264, 34735
METADATA, NO_DATA = 42112, 42113
"""Codes of the tags of the GeoTIFF standard, and of GDAL's own."""
UNDEFINED = (0, 32767)
"""EPSG's codes of what a file leaves undefined, or defines itself."""
FOOT, SURVEY_FOOT = 0.3048, 1200 / 3937
UNIT_NAMES = {
    1.0: ("m", "metre", "metres", "meter", "meters"),
    FOOT: ("ft", "foot", "feet", "foot (international)", "international foot", "international feet"),
    SURVEY_FOOT: ("us survey foot", "us survey feet", "us-ft", "ftus", "foot_us", "foot us survey"),
    0.01: ("cm", "centimetre", "centimeter"),
    0.001: ("mm", "millimetre", "millimeter"),
    1000.0: ("km", "kilometre", "kilometer"),
}
"""Names of the units of a band."""
# What tifffile says of odd tags is no news to users: they are read here.
logging.getLogger("tifffile").addHandler(logging.NullHandler())


class GeoTags(NamedTuple):
    """Meaning of the values of a GeoTIFF: the height of a value is ``scale * value + offset``, m.

    ``cell`` is the spacing from column to column along x and from row to row along -y, m, and ``corner`` the position
    of the middle of the first value, m, where they are known. ``no_meters`` says why they are not known in meters, and
    what helps, and ``notes`` what the units are.
    """

    scale: float = 1.0
    offset: float = 0.0
    cell: tuple[float, float] | None = None
    corner: tuple[float, float] | None = None
    no_meters: str = ""
    notes: tuple[str, ...] = ()


class Elevations(NamedTuple):
    """Numbers of a picture or an array, float64 ``[rows, columns]``, the first row first, NaN where there is no data.

    ``white`` is the largest number of unsigned integers, 1 for other types.
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
    tags, values = found.tags or GeoTags(), found.values
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
        west = tags.corner[0] + min(0.0, cell[0]) * (columns - 1)
        south = tags.corner[1] - max(0.0, cell[1]) * (rows - 1)
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
    return float(np.iinfo(values.dtype).max) if values.dtype.kind == "u" else 1.0


def _check_pixels(path: Path, shape: tuple[int, ...]) -> None:
    if math.prod(shape) > MAX_PIXELS:
        size = " x ".join(map(str, shape))
        raise ValueError(f"{path} has {size} values; at most {MAX_PIXELS:,} are supported, so scale it down first")


def read_picture(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Reads a picture as gray values ``[rows, columns]``, and which of them are clear, if it has an alpha channel.

    Values are uint8 or uint16, or float32 of a picture of floats.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(path.read_bytes()))
        _check_pixels(path, image.size)
        if image.mode.startswith("I"):
            # Pillow reads 16 bit pictures as 16 or as 32 bit integers, depending on the version.
            return np.asarray(image).astype(np.uint16), None
        clear = np.asarray(image.convert("RGBA"))[..., 3] < 255 if image.has_transparency_data else None
        if image.mode in ("F", "L", "1"):
            return np.asarray(image if image.mode == "F" else image.convert("L")), clear
        return np.asarray(image.convert("RGB")).mean(-1).round().astype(np.uint8), clear
    except UnidentifiedImageError as error:
        raise ValueError(f"{path} is no picture that can be read") from error
    except (Image.DecompressionBombError, OSError, SyntaxError, EOFError, OverflowError, MemoryError) as error:
        raise ValueError(f"{path} is a damaged or too large picture: {error}") from error


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
    try:
        with tifffile.TiffFile(io.BytesIO(path.read_bytes())) as file:
            page = file.pages[0]
            _check_pixels(path, page.shape)
            tags = {tag.code: tag.value for tag in page.tags.values()}
            bands = np.moveaxis(page.asarray(), page.axes.index("S"), 0) if "S" in page.axes else [page.asarray()]
            values, meaning = bands[0], _read_tags(path.name, tags, page.geotiff_tags or {})
            hidden = _is_missing(values, tags)
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


def _is_missing(values: np.ndarray, tags: dict[int, Any]) -> np.ndarray:
    missing = np.zeros(values.shape, dtype=bool)
    with suppress(ValueError):
        number = float(str(tags.get(NO_DATA, "")).strip(" \0"))
        exact = values.astype(float)
        missing = exact == number
        if values.dtype.kind == "f" and math.isfinite(number):
            # Floats may differ from GDAL's no-data value in their last digits.
            missing |= np.abs(exact - number) < 2 * np.finfo(values.dtype).eps * np.abs(exact + number)
    return missing


def _read_tags(name: str, tags: dict[int, Any], keys: dict[str, Any]) -> GeoTags | None:
    """Returns the meaning of the values of a TIFF, by its name, its tags and its keys. ``None`` if it is no GeoTIFF."""
    if not tags.keys() & {PIXEL_SCALE, TRANSFORMATION, KEYS}:
        return None
    items = dict[str, str]()
    if METADATA in tags:
        elements = parse_xml(str(tags[METADATA]).strip(" \0").encode()).iter("Item")
        items = {item.get("role", ""): text_of(item) for item in elements if item.get("sample") == "0"}
    upright = _height_unit(keys, items.get("unittype", ""))
    scale, offset = upright * float(items.get("scale") or 1), upright * float(items.get("offset") or 0)
    found = GeoTags(scale, offset, notes=_about("heights", upright))
    transform = _transform(tags)
    if transform is None:
        return found
    (dx, shear, x), (turn, dy, y) = transform.tolist()
    if shear or turn:
        return found._replace(no_meters=f"is turned or sheared: turn it with gdalwarp -dstalpha {name} north_up.tif")
    if not (dx and dy and np.isfinite(transform).all()):
        raise ValueError(f"the pixels of {name} must have a size, got {dx:g} x {dy:g}")
    unit = _unit(keys)
    if unit is None:
        zone = (32601 if y >= 0 else 32701) + math.floor((x + 180) / 6) % 60
        reproject = f"gdalwarp -dstalpha -t_srs EPSG:{zone} {name} meters.tif"
        return found._replace(no_meters=f"is in degrees, not in meters: reproject it with {reproject}")
    notes = (*_about("lengths", unit), *found.notes)
    if unit != 1 and not (items.get("unittype") or keys.keys() & {"VerticalCSTypeGeoKey", "VerticalUnitsGeoKey"}):
        notes += ("ground: the file says no unit of its heights, and they are taken as meters",)
    # 2 means that a value belongs to a point, otherwise to the area of a pixel.
    half = 0.0 if keys.get("GTRasterTypeGeoKey") == 2 else 0.5
    placed = TRANSFORMATION in tags or TIE_POINT in tags
    corner = (unit * (x + half * dx), unit * (y + half * dy)) if placed else None
    return found._replace(cell=(unit * dx, -unit * dy), corner=corner, notes=notes)


def _about(what: str, unit: float) -> tuple[str, ...]:
    return () if unit == 1 else (f"ground: {what} in the file are in units of {unit:.9g} m",)


def _transform(tags: dict[int, Any]) -> np.ndarray | None:
    """Returns x and y as linear functions of (column, row, 1) of a pixel's corner, ``[2, 3]``, or ``None``."""
    if PIXEL_SCALE in tags:
        dx, dy = tags[PIXEL_SCALE][:2]
        column, row, _, x, y, _ = (*tags.get(TIE_POINT, ()), *6 * (0.0,))[:6]
        # GDAL, too, ignores the sign of the scale along y.
        return np.array([(dx, 0.0, x - column * dx), (0.0, -abs(dy), y + row * abs(dy))])
    matrix = np.ravel(tags.get(TRANSFORMATION, ()))
    return matrix.reshape(4, 4)[:2, [0, 1, 3]] if matrix.size == 16 else None


def _unit(keys: dict[str, Any]) -> float | None:
    """Returns the unit of the coordinates, m. ``None``: degrees."""
    model, system = keys.get("GTModelTypeGeoKey"), keys.get("ProjectedCSTypeGeoKey")
    if model == 2 or (model is None and system is None and "GeographicTypeGeoKey" in keys):
        return None
    if (unit := keys.get("ProjLinearUnitsGeoKey")) is None:
        return _unit_of_system(system or 0)
    return _unit_of_code(unit) if unit not in UNDEFINED else float(keys.get("ProjLinearUnitSizeGeoKey", 1.0))


def _height_unit(keys: dict[str, Any], name: str) -> float:
    named = next((unit for unit, names in UNIT_NAMES.items() if name.lower() in names), None)
    if named is None and (system := keys.get("VerticalCSTypeGeoKey", 0)) not in UNDEFINED:
        named = _unit_of_system(system)
    return _unit_of_code(keys.get("VerticalUnitsGeoKey", 0)) if named is None else named


def _unit_of_code(code: int) -> float:
    """Returns the unit of length with EPSG's code, m: meters if there is none."""
    if code in UNDEFINED:
        return 1.0
    units = optional("pyproj.database").get_units_map("EPSG", "linear", allow_deprecated=True).values()
    return next((unit.conv_factor for unit in units if unit.code == f"{code:d}"), 1.0)


def _unit_of_system(code: int) -> float | None:
    """Returns the unit of a coordinate system by EPSG's code, m: meters if there is none, ``None`` for degrees."""
    if code not in UNDEFINED:
        pyproj = optional("pyproj")
        with suppress(pyproj.exceptions.CRSError):
            system = pyproj.CRS.from_epsg(int(code))
            return None if system.is_geographic else system.axis_info[0].unit_conversion_factor
    return 1.0
