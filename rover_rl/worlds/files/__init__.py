"""Importers of worlds: SDF, meshes, elevation models, occupancy grids, and the project's own world files."""

from __future__ import annotations

from importlib import import_module
from typing import Any

SDF_SUFFIXES = (".sdf", ".world")
MESH_SUFFIXES = (".obj", ".stl", ".dae", ".glb", ".gltf", ".ply")
TIFF_SUFFIXES = (".tif", ".tiff")
ELEVATION_SUFFIXES = (*TIFF_SUFFIXES, ".png", ".npy", ".pgm", ".jpg", ".jpeg", ".bmp")
MAP_SUFFIXES = (".yaml", ".yml")
ARCHIVE_SUFFIX = ".world.npz"
SUFFIXES = (*SDF_SUFFIXES, *MESH_SUFFIXES, *ELEVATION_SUFFIXES, *MAP_SUFFIXES, ARCHIVE_SUFFIX)
"""Suffixes of the files that worlds are read from."""


def is_world_file(name: str) -> bool:
    """Returns whether the name of a world is the path of a file: by its suffix, or because it has a folder."""
    return name.lower().endswith((*SUFFIXES, ".npz")) or "/" in name or "\\" in name


def optional(module: str) -> Any:
    """Imports a module of the extra ``worlds``. If it is not installed, the error says how to install it."""
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(f'this world file needs the package {module}: pip install "rover_rl[worlds]"') from error
