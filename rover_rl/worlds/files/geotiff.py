"""What the tags of a GeoTIFF say of its values: spacing, position, units and no-data, as GDAL reads them."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from rover_rl.tiny_xml import parse_xml, text_of
from rover_rl.worlds.files import optional

PIXEL_SCALE, TIE_POINT, TRANSFORMATION, KEYS, DOUBLES = 33550, 33922, 34264, 34735, 34736
METADATA, NO_DATA = 42112, 42113
"""Codes of the tags of the GeoTIFF standard, and of GDAL's own."""
MODEL, RASTER, GEOGRAPHIC, PROJECTED, UNIT, UNIT_SIZE = 1024, 1025, 2048, 3072, 3076, 3077
VERTICAL, VERTICAL_UNIT = 4096, 4099
"""Codes of the keys in the tag :data:`KEYS`."""
USER_DEFINED = 32767
FOOT, SURVEY_FOOT = 0.3048, 1200 / 3937
UNITS: dict[float, float] = {0: 1.0, USER_DEFINED: 1.0, 9001: 1.0, 9002: FOOT, 9003: SURVEY_FOOT}
"""Units of length by EPSG's codes, m. What the file leaves undefined is meters."""
UNIT_NAMES = {
    1.0: ("m", "metre", "metres", "meter", "meters"),
    FOOT: ("ft", "foot", "feet", "foot (international)", "international foot", "international feet"),
    SURVEY_FOOT: ("us survey foot", "us survey feet", "us-ft", "ftus", "foot_us", "foot us survey"),
    0.01: ("cm", "centimetre", "centimeter"),
    0.001: ("mm", "millimetre", "millimeter"),
    1000.0: ("km", "kilometre", "kilometer"),
}
"""Names of the units of a band."""


class GeoTags(NamedTuple):
    """Meaning of the values of a GeoTIFF.

    Attributes:
        scale: the height of a value is ``scale * value + offset``, m.
        offset: see ``scale``.
        cell: spacing from column to column along x and from row to row along -y, m. ``None``: not known.
        corner: position of the middle of the first value, m. ``None``: not known.
        no_meters: why the spacing is not known in meters, and what helps.
        notes: what the units are if not meters.
    """

    scale: float
    offset: float
    cell: tuple[float, float] | None = None
    corner: tuple[float, float] | None = None
    no_meters: str = ""
    notes: tuple[str, ...] = ()


def read_tags(name: str, tags: dict[int, Any]) -> GeoTags | None:
    """Returns the meaning of the values of a TIFF, by its name and its tags. ``None`` if it is no GeoTIFF."""
    if not tags.keys() & {PIXEL_SCALE, TRANSFORMATION, KEYS}:
        return None
    keys, items = _keys(tags), _band_items(tags)
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
    notes = [*_about("lengths", unit), *found.notes]
    if unit != 1 and not (items.get("unittype") or keys.keys() & {VERTICAL, VERTICAL_UNIT}):
        notes.append("ground: the file says no unit of its heights, and they are taken as meters")
    # Key RASTER: 2 means that a value belongs to a point, otherwise to the area of a pixel.
    half = 0.0 if keys.get(RASTER) == 2 else 0.5
    placed = TRANSFORMATION in tags or TIE_POINT in tags
    corner = (unit * (x + half * dx), unit * (y + half * dy)) if placed else None
    return found._replace(cell=(unit * dx, -unit * dy), corner=corner, notes=tuple(notes))


def is_missing(values: np.ndarray, tags: dict[int, Any]) -> np.ndarray:
    """Returns which values are GDAL's no-data value, bool. Floats may differ from it in their last digits."""
    missing = np.zeros(values.shape, dtype=bool)
    with suppress(ValueError):
        number = float(str(tags.get(NO_DATA, "")).strip(" \0"))
        exact = values.astype(float)
        missing = exact == number
        if values.dtype.kind == "f" and math.isfinite(number):
            missing |= np.abs(exact - number) < 2 * np.finfo(values.dtype).eps * np.abs(exact + number)
    return missing


def _about(what: str, unit: float) -> tuple[str, ...]:
    return () if unit == 1 else (f"ground: {what} in the file are in units of {unit:.9g} m",)


def _keys(tags: dict[int, Any]) -> dict[int, float]:
    directory, doubles = [*tags.get(KEYS, ())], np.ravel(tags.get(DOUBLES, ()))
    found = {}
    for k in range(4, len(directory) - 3, 4):
        key, place, _, value = directory[k : k + 4]
        if place == 0:
            found[key] = float(value)
        elif place == DOUBLES and value < len(doubles):
            found[key] = float(doubles[value])
    return found


def _band_items(tags: dict[int, Any]) -> dict[str, str]:
    if METADATA not in tags:
        return {}
    items = parse_xml(str(tags[METADATA]).strip(" \0").encode()).iter("Item")
    return {item.get("role", ""): text_of(item) for item in items if item.get("sample") == "0"}


def _transform(tags: dict[int, Any]) -> np.ndarray | None:
    """Returns x and y as linear functions of (column, row, 1) of a pixel's corner, ``[2, 3]``, or ``None``."""
    if PIXEL_SCALE in tags:
        dx, dy = tags[PIXEL_SCALE][:2]
        column, row, _, x, y, _ = (*tags.get(TIE_POINT, ()), *6 * (0.0,))[:6]
        # GDAL, too, ignores the sign of the scale along y.
        return np.array([(dx, 0.0, x - column * dx), (0.0, -abs(dy), y + row * abs(dy))])
    matrix = np.ravel(tags.get(TRANSFORMATION, ()))
    return matrix.reshape(4, 4)[:2, [0, 1, 3]] if matrix.size == 16 else None


def _unit(keys: dict[int, float]) -> float | None:
    """Returns the unit of the coordinates, m. ``None``: degrees."""
    if keys.get(MODEL) == 2 or (GEOGRAPHIC in keys and not keys.keys() & {MODEL, PROJECTED}):
        return None
    if UNIT in keys:
        return keys[UNIT_SIZE] if keys[UNIT] == USER_DEFINED and UNIT_SIZE in keys else _unit_of_code(keys[UNIT])
    return _unit_of_system(keys.get(PROJECTED, 0))


def _height_unit(keys: dict[int, float], name: str) -> float:
    named = next((unit for unit, names in UNIT_NAMES.items() if name.lower() in names), None)
    if named is None and keys.get(VERTICAL, 0) not in UNITS:
        named = _unit_of_system(keys[VERTICAL])
    return _unit_of_code(keys.get(VERTICAL_UNIT, 0)) if named is None else named


def _unit_of_code(code: float) -> float:
    if code in UNITS:
        return UNITS[code]
    units = optional("pyproj.database").get_units_map("EPSG", "linear", allow_deprecated=True).values()
    return next((unit.conv_factor for unit in units if unit.code == f"{code:.0f}"), 1.0)


def _unit_of_system(code: float) -> float | None:
    """Returns the unit of a coordinate system by EPSG's code, m: meters if there is none, ``None`` for degrees."""
    if code in UNITS:
        return 1.0
    pyproj = optional("pyproj")
    with suppress(pyproj.exceptions.CRSError):
        system = pyproj.CRS.from_epsg(int(code))
        return None if system.is_geographic else system.axis_info[0].unit_conversion_factor
    return 1.0
