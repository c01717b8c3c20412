"""Formats of world files, and the options of their importers."""

from __future__ import annotations

from dataclasses import dataclass, fields
from importlib import import_module
from typing import Any, Literal, TypeAlias, Union, get_args

import numpy as np

from rover_rl.option_names import written
from rover_rl.worlds.region import Area

SDF_SUFFIXES = (".sdf", ".world")
MESH_SUFFIXES = (".obj", ".stl", ".dae", ".glb", ".gltf", ".ply")
TIFF_SUFFIXES = (".tif", ".tiff")
ELEVATION_SUFFIXES = (*TIFF_SUFFIXES, ".png", ".npy", ".pgm", ".jpg", ".jpeg", ".bmp")
MAP_SUFFIXES = (".yaml", ".yml")
ARCHIVE_SUFFIX = ".world.npz"
SUFFIXES = (*SDF_SUFFIXES, *MESH_SUFFIXES, *ELEVATION_SUFFIXES, *MAP_SUFFIXES, ARCHIVE_SUFFIX)
MAX_SIZE = 10_000.0
"""Largest distance of anything in an imported world from the origin, m."""
MAX_TRIANGLES = 170_000
"""Largest number of triangles of all obstacles: Bullet's limit for the mesh that takes the lidar rays."""

Missing = Literal["error", "skip"]
Unknown = Literal["open", "wall", "free"]
Up = Literal["auto", "x", "y", "z"]
Place: TypeAlias = Union[Area, tuple[float, float], list[tuple[float, float]]]  # noqa: UP007
_CHOICES = {"missing": Missing, "unknown": Unknown, "up": Up}
_RANGES = {
    "cell": (0.005, 100.0),
    "scale": (1e-6, 1e6),
    "obstacle_error": (0.001, 1.0),
    "pixel": (1e-4, 1000.0),
    "height": (-MAX_SIZE, MAX_SIZE),
    "wall_height": (0.01, 1000.0),
}


def is_world_file(name: str) -> bool:
    """Returns whether the name of a world is the path of a file: by its suffix, or because it has a folder."""
    return name.lower().endswith((*SUFFIXES, ".npz")) or "/" in name or "\\" in name


def optional(module: str) -> Any:
    """Imports a module of the extra ``worlds``. If it is not installed, the error says how to install it."""
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(f'this world file needs the package {module}: pip install "rover_rl[worlds]"') from error


@dataclass(frozen=True)
class ImportOptions:
    """Options of :meth:`rover_rl.World.from_file`. An option without meaning for a format has no effect.

    Args:
        name: name of the world. ``None``: that in the file, else the file's name.
        spawn_range: area in which episodes start: a rectangle ``((x_low, x_high), (y_low, y_high))``, the corners
            ``[(x, y), ...]`` of a polygon, or a point ``(x, y)``, which stands for the free ground that is connected
            with it, m. ``None``: the largest free ground that obstacles enclose, else the largest one.
        goal_range: area of the goals, in the same forms. ``None``: ``spawn_range``.
        bounds: area whose exit ends the episode. ``None``: automatic.
        cell: spacing of the ground's grid, m. ``None``: that of the elevation data, or for meshes the coarsest of 0.1,
            0.05 and 0.025 m whose error is at most 1 cm for 99 % of the ground.
        missing: what happens with models and meshes that are not found: ``"error"``, or ``"skip"`` with a warning.
        model_paths: folders with models, for ``model://NAME``, before those of the environment variables.
        visuals: take the visual geometry of links that have no collision geometry.
        ground: parts of a mesh file, or models and links of an SDF file, that are ground: ``"auto"``, ``"none"``, or
            patterns such as ``"terrain*"``, separated by commas.
        up: axis of a mesh file that points up. ``"auto"``: that of the format (glTF: y; COLLADA: in the file; else z).
        scale: factor from the lengths of a mesh file to meters, on top of the unit in the file.
        obstacle_error: accepted distance between an obstacle and the convex solids that replace it, m.
        pixel: size of a pixel of an elevation image or array, m. ``None``: that of the GeoTIFF.
        height: elevation of white in an 8 or 16 bit image, m; factor for the values of other files.
        unknown: meaning of an occupancy grid's unknown cells: ``"open"`` (no wall, and automatic areas leave them
            out), ``"wall"`` or ``"free"``.
        wall_height: height of the walls of an occupancy grid, m.

    Raises:
        ValueError: for a value out of range.
    """

    name: str | None = None
    spawn_range: Place | None = None
    goal_range: Place | None = None
    bounds: Area | None = None
    cell: float | None = None
    missing: Missing = "error"
    model_paths: tuple[str, ...] = ()
    visuals: bool = True
    ground: str = "auto"
    up: Up = "auto"
    scale: float = 1.0
    obstacle_error: float = 0.02
    pixel: float | None = None
    height: float | None = None
    unknown: Unknown = "open"
    wall_height: float = 2.0

    def __post_init__(self) -> None:
        for name, choice in _CHOICES.items():
            if getattr(self, name) not in get_args(choice):
                raise ValueError(f"{written(name)} must be one of {[*get_args(choice)]}, got {getattr(self, name)!r}")
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if value is not None and (isinstance(value, bool) or not isinstance(value, (int, float))):
                raise ValueError(f"{name} must be a number, got {value!r}")
            if value is not None and not low <= value <= high:
                raise ValueError(f"{written(name)} must be from {low:g} to {high:g}, got {value}")
        for name in ("spawn_range", "goal_range", "bounds"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _place(name, getattr(self, name)))
        paths = (self.model_paths,) if isinstance(self.model_paths, str) else self.model_paths
        object.__setattr__(self, "model_paths", tuple(map(str, paths)))


def make_options(given: dict[str, Any]) -> ImportOptions:
    known = [field.name for field in fields(ImportOptions)]
    if unknown := sorted(set(given) - set(known)):
        raise ValueError(f"unknown options of a world file: {unknown}; use some of {known}")
    return ImportOptions(**given)


def _place(name: str, place: Any) -> Any:
    try:
        numbers = np.array(place, dtype=float)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    is_area = numbers.shape == (2, 2) and bool((numbers[:, 0] < numbers[:, 1]).all())
    is_polygon = numbers.ndim == 2 and numbers.shape[1] == 2 and len(numbers) > 2
    allowed = is_area or (name != "bounds" and (is_polygon or numbers.shape == (2,)))
    if not (allowed and (np.abs(numbers) <= MAX_SIZE).all()):
        forms = "((x_low, x_high), (y_low, y_high))"
        if name != "bounds":
            forms = f"a rectangle {forms}, a polygon [(x, y), ...] or a point (x, y)"
        raise ValueError(f"{written(name)} must be {forms} within {MAX_SIZE:g} m, got {place}")
    if numbers.ndim == 1:
        return tuple(numbers.tolist())
    points = [tuple(pair) for pair in numbers.tolist()]
    return tuple(points) if is_area else points
