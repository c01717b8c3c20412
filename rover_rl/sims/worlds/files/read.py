"""Reading of world files of all formats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rover_rl.option_names import written
from rover_rl.progress import ProgressDisplay
from rover_rl.sims.worlds.files.archive import read_archive
from rover_rl.sims.worlds.files.assemble import WorldParts, assemble
from rover_rl.sims.worlds.files.contents import Contents
from rover_rl.sims.worlds.files.elevation import read_elevation
from rover_rl.sims.worlds.files.mesh_files import read_mesh
from rover_rl.sims.worlds.files.occupancy import read_map
from rover_rl.sims.worlds.files.options import ImportOptions, make_options
from rover_rl.sims.worlds.files.sdf import read_sdf
from rover_rl.sims.worlds.files.suffixes import ELEVATION_SUFFIXES, MAP_SUFFIXES, SDF_SUFFIXES, SUFFIXES


def read_world(path: Path, **options: Any) -> WorldParts:
    """Reads the parts of a world from a file. See :meth:`rover_rl.World.from_file`.

    Raises:
        FileNotFoundError: if there is no such file.
        ImportError: if a package of the extra ``worlds`` is missing.
        ValueError: if the file or an option is wrong. The message is one sentence.
    """
    chosen = make_options(options)
    if not path.is_file():
        raise FileNotFoundError(f"there is no world file {path}")
    suffix = path.suffix.lower()
    if suffix == ".npz":
        if options:
            given = [written(name) for name in sorted(options)]
            raise ValueError(f"{path} is imported already: give {given} when it is imported")
        return read_archive(path)
    if suffix not in SUFFIXES:
        raise ValueError(f"{path} is no world file; use one of {[*SUFFIXES]}")
    # Convex decomposition of large meshes takes minutes.
    with ProgressDisplay(f"importing {path.name}") as display:
        return read_map(path, chosen) if suffix in MAP_SUFFIXES else assemble(_contents(path, chosen), chosen, display)


def _contents(path: Path, options: ImportOptions) -> Contents:
    """Returns what an SDF file, an elevation model or a mesh holds."""
    suffix = path.suffix.lower()
    if suffix in SDF_SUFFIXES:
        return read_sdf(path, options)
    if suffix in ELEVATION_SUFFIXES:
        return read_elevation(path, options)
    return Contents(path.name.partition(".")[0], read_mesh(path, options.up, options.scale))
