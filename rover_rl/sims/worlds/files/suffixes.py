"""Names of world files."""

from __future__ import annotations

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
