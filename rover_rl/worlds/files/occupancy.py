"""Occupancy grids: ``map.yaml`` of ROS with its picture."""

from __future__ import annotations

import math
import re
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from rover_rl.option_names import written
from rover_rl.worlds.files.areas import find_areas
from rover_rl.worlds.files.contents import Plane
from rover_rl.worlds.files.elevation import read_picture, white_of
from rover_rl.worlds.files.ground import Ground, make_terrain
from rover_rl.worlds.files.locate import Locator
from rover_rl.worlds.files.options import MAX_SIZE, MAX_TRIANGLES, ImportOptions
from rover_rl.worlds.files.rectangles import cover, slanted_cover
from rover_rl.worlds.solids import Solids, box, hull

MODES = ("trinary", "scale", "raw")
MAX_PIECES = MAX_TRIANGLES // 12
"""Largest number of boxes and other pieces of the walls."""
OCCUPIED, UNKNOWN = 100, 255
"""Values of nav_msgs/OccupancyGrid; UNKNOWN is its -1 as an unsigned byte."""
_NUMBER = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
"""A number of yaml-cpp, which reads maps in ROS. Quotes make no difference."""
_INTEGER = re.compile(r"[-+]?[0-9]+|0x[0-9a-fA-F]+|0o[0-7]+")
_TRUE, _FALSE = ("y", "yes", "true", "on"), ("n", "no", "false", "off")


class _Map(NamedTuple):
    """The settings of a map, as nav2's map_server reads them."""

    image: str
    mode: str
    resolution: float
    origin: tuple[float, float, float]
    negate: bool
    occupied: float
    free: float

    @property
    def axes(self) -> np.ndarray:
        """Axes of the map in the frame of the world, which the yaw of the origin turns: ``[2, 2]``, as rows."""
        cos, sin = math.cos(self.origin[2]), math.sin(self.origin[2])
        return np.array([[cos, sin], [-sin, cos]])

    def points(self, cells: np.ndarray) -> np.ndarray:
        """Returns positions (m) of points in cells from the lower left corner: ``[P, 2]``."""
        return self.resolution * cells @ self.axes + self.origin[:2]

    def lookup(self, cells: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Returns the values of the cells at positions ``[..., 2]`` (m), true outside of the map: bool ``[...]``."""
        index = np.floor((points - self.origin[:2]) @ self.axes.T / self.resolution).astype(int)
        inside = ((index >= 0) & (index < cells.shape[::-1])).all(-1)
        column, row = np.moveaxis(np.where(inside[..., None], index, 0), -1, 0)
        return ~inside | cells[row, column]


def read_map(path: Path, options: ImportOptions) -> dict[str, Any]:
    """Returns the fields of the world of an occupancy grid: walls become boxes on flat ground.

    Cells are occupied, free or unknown as in nav2's map_server. ``trinary`` and ``scale`` compare the darkness of a
    pixel with the thresholds; between them it is unknown, also where ``scale`` gives a share. ``raw`` takes the values
    as they are: 100 is occupied, more is unknown, and less is free.
    """
    settings = _settings(path)
    picture, renamed = _picture(path, settings.image)
    states = _states(settings, *read_picture(picture))
    rows, columns = states.shape
    width, depth = columns * settings.resolution, rows * settings.resolution
    if max(width, depth) > MAX_SIZE:
        raise ValueError(f"{path} spans {width:g} x {depth:g} m, too large")
    if not (states == 0).any():
        raise ValueError(f"{path} has no free cell; check negate and the thresholds")
    walls = (states == OCCUPIED) | ((states == UNKNOWN) & (options.unknown == "wall"))
    obstacles, about_walls = _walls(path, settings, walls, options)
    known = states == 0 if options.unknown == "open" else states != OCCUPIED
    centers = settings.points(np.argwhere(known)[:, ::-1] + 0.5)
    corners = settings.points(np.array([(0, 0), (columns, 0), (0, rows), (columns, rows)], dtype=float))
    terrain, _ = make_terrain(Ground([Plane(np.zeros(3))], [], []), corners, None)
    low, high = centers.min(0) - settings.resolution / 2, centers.max(0) + settings.resolution / 2
    limits = (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))
    areas, about = find_areas(terrain, obstacles, options, limits, partial(settings.lookup, known | walls))
    share = float((states == UNKNOWN).mean())
    unknown = [f"map: {100 * share:.0f} % of the cells are unknown, taken as {options.unknown}"] if share else []
    notes = (*renamed, f"map: {int(walls.sum()):,} wall cells in {about_walls}", *unknown, *about)
    return {"name": options.name or path.stem, "terrain": terrain, "obstacles": obstacles, **areas, "notes": notes}


def _picture(path: Path, name: str) -> tuple[Path, list[str]]:
    """Returns the picture of a map, and a note if it is not the one that the map names.

    A map whose two files were renamed together still names the old picture: then the one beside it with its own new
    name is taken.
    """
    found = Locator(path).find(name, path.parent)
    if found is not None and found.is_file():
        return found, []
    for suffix in (Path(name).suffix, ".pgm", ".png"):
        other = path.with_suffix(suffix)
        if other.is_file() and other != path:
            return other, [f"map: the picture {name} does not exist, and {other.name} is taken"]
    raise FileNotFoundError(f"{path} names the picture {name}, which does not exist")


def _settings(path: Path) -> _Map:
    try:
        # Leaves numbers as text: yaml-cpp takes more for numbers than PyYAML does.
        data = yaml.load(path.read_bytes(), yaml.BaseLoader)
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f"{path} is not valid YAML: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(data, dict) or not {"image", "resolution", "origin"} <= set(data):
        raise ValueError(f"{path} is no map: it must have image, resolution and origin")

    def check(key: str, is_right: bool, must: str) -> None:
        if not is_right:
            raise ValueError(f"{key} in {path} must be {must}, got {data[key]}")

    def number(key: str, low: float, high: float, usual: str = "") -> float:
        value = _number(data.get(key, usual))
        check(key, low <= value <= high, f"a number from {low:g} to {high:g}")
        return value

    image, mode, origin = data["image"], str(data.get("mode", "trinary")).lower(), data["origin"]
    check("mode", mode in MODES, f"one of {[*MODES]}")
    check("image", isinstance(image, str) and image != "", "the name of a file")
    occupied, free = number("occupied_thresh", 0.0, 1.0, "0.65"), number("free_thresh", 0.0, 1.0, "0.25")
    if free >= occupied:
        raise ValueError(f"free_thresh in {path} must be below occupied_thresh, got {free:g} and {occupied:g}")
    resolution = number("resolution", 1e-3, 100.0)
    pose = [*map(_number, origin)] if isinstance(origin, list) else []
    is_pose = len(pose) in (2, 3) and all(abs(value) <= MAX_SIZE for value in pose)
    check("origin", is_pose, f"[x, y, yaw] within {MAX_SIZE:g} m")
    x, y, yaw = (*pose, 0.0)[:3]
    negate = str(data.get("negate", "0"))
    # yaml-cpp knows true, True and TRUE, but not tRUE.
    is_word = negate.lower() in (*_TRUE, *_FALSE) and negate in (negate.lower(), negate.upper(), negate.capitalize())
    check("negate", is_word or _INTEGER.fullmatch(negate) is not None, "0 or 1")
    inverse = negate.lower() in _TRUE if is_word else int(negate, 0 if negate[:2] in ("0x", "0o") else 10) != 0
    return _Map(image, mode, resolution, (x, y, yaw), inverse, occupied, free)


def _number(value: Any) -> float:
    return float(value) if isinstance(value, str) and _NUMBER.fullmatch(value) else math.nan


def _states(settings: _Map, gray: np.ndarray, clear: np.ndarray | None) -> np.ndarray:
    """Returns 0 (free), 100 (occupied) or 255 (unknown) of each cell, with rows along +y: ``[rows, columns]``.

    As in map_server, cells that are ``clear``, in part or entirely, are unknown, but for ``raw``.
    """
    shade = gray[::-1] / white_of(gray)
    if settings.mode == "raw":
        values = np.rint(255 * shade)
        return np.where(values == OCCUPIED, OCCUPIED, np.where(values > OCCUPIED, UNKNOWN, 0)).astype(np.uint8)
    occupancy = shade if settings.negate else 1.0 - shade
    free = np.where(occupancy < settings.free, 0, UNKNOWN)
    states = np.where(occupancy > settings.occupied, OCCUPIED, free)
    return (states if clear is None else np.where(clear[::-1], UNKNOWN, states)).astype(np.uint8)


def _walls(path: Path, settings: _Map, walls: np.ndarray, options: ImportOptions) -> tuple[list[Solids], str]:
    """Returns the walls as exact boxes, or if those are too many, as slanted pieces, and a note.

    If these are too many, too, walls become thicker by ``obstacle_error`` at most, if that is two cells or more.
    """
    height = options.wall_height
    rectangles = cover(walls)
    if len(rectangles) <= MAX_PIECES:
        solids = []
        for row, column, rows, columns in rectangles:
            ((x, y),) = settings.points(np.array([(column + columns / 2, row + rows / 2)]))
            sides = settings.resolution * columns, settings.resolution * rows, height
            solids.append(box((float(x), float(y), height / 2), sides, yaw=settings.origin[2]))
        return solids, f"{len(rectangles):,} boxes"
    for size in (1, int(options.obstacle_error / settings.resolution + 1e-3)):
        pieces = _slanted(walls, size)
        if len(pieces) <= MAX_PIECES:
            corners = [settings.points(piece) for piece in pieces]
            prisms = [np.concatenate([np.insert(ring, 2, z, axis=1) for z in (0.0, height)]) for ring in corners]
            note = f"{len(pieces):,} slanted pieces, within about {settings.resolution * max(1, size):.2g} m"
            return [hull(points) for points in prisms], note
    sizes = (2**k for k in range(1, 20))
    enough = settings.resolution * next(size for size in sizes if len(_slanted(walls, size)) <= MAX_PIECES)
    thicker = f"accept {written('obstacle_error')}={enough:g}, with thicker walls, or " if enough <= 1 else ""
    raise ValueError(
        f"the walls of {path} are {len(pieces):,} pieces; at most {MAX_PIECES:,} are supported, so {thicker}crop the "
        "picture or scale it down"
    )


def _slanted(walls: np.ndarray, size: int) -> np.ndarray:
    if size > 1:
        walls = np.pad(walls, [(0, -side % size) for side in walls.shape])
        rows, columns = (side // size for side in walls.shape)
        walls = np.any(walls.reshape(rows, size, columns, size), axis=(1, 3))
    return max(1, size) * slanted_cover(walls)
