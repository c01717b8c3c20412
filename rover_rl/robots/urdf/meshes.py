"""Mesh files that a URDF names: where they are, and what they hold."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rover_rl.native.output import logged

if TYPE_CHECKING:
    import trimesh

FOUND_PACKAGE = re.compile(r"(file://)?\$\(find\s+([\w-]+)\)")
"""Folder of a ROS package in a file name, as xacro states it."""
_PACKAGE = "package://"
_NAME = re.compile(r"<name>\s*([^<\s]+)\s*</name>")
"""Name of a ROS package in its package.xml."""
_UNIT = re.compile(rb"<unit[^>]*\bmeter\s*=\s*[\"']\s*([0-9.eE+-]+)")
"""Unit that a COLLADA file states, m. trimesh does not apply it."""


def find_mesh(file: str, urdf: Path) -> Path:
    """Returns the path of a mesh file: absolute, beside the URDF, or in the ROS package that holds the URDF."""
    folder = urdf.resolve().parent
    file = FOUND_PACKAGE.sub(rf"{_PACKAGE}\2", file)
    paths = [folder / file.removeprefix("file://")]
    if file.startswith(_PACKAGE):
        package, _, rest = file.removeprefix(_PACKAGE).partition("/")
        parents = (folder, *folder.parents)
        paths = [parent / rest for parent in parents if package in (parent.name, _package_name(parent))]
        paths += [parent / package / rest for parent in parents]
    if found := next((path for path in paths if path.is_file()), None):
        return found
    raise ValueError(f"the mesh {file!r} does not exist; mesh files are relative to the folder of the URDF")


def readable_mesh(file: str, urdf: Path) -> Path:
    """Returns the path of a mesh file that :func:`load_mesh` may read. Raises ``ValueError`` for others."""
    import trimesh

    path = find_mesh(file, urdf)
    if path.suffix.lower().lstrip(".") not in trimesh.available_formats():
        raise ValueError(f"the mesh {file!r} has a format that cannot be read")
    return path


def _package_name(folder: Path) -> str:
    """Name of the ROS package in a folder; of another folder, nothing."""
    try:
        stated = _NAME.search((folder / "package.xml").read_text(errors="replace"))
    except OSError:
        return ""
    return stated[1] if stated else ""


def load_mesh(
    path: Path, scale: Sequence[float] = (1.0, 1.0, 1.0), lost: list[str] | None = None
) -> list[trimesh.Trimesh]:
    """Loads a mesh file in any format of trimesh, such as OBJ and STL, and scales it to meters.

    A file may hold several meshes of different colors. If it names pictures or materials that cannot be read, ``lost``
    gets a sentence.

    Raises:
        ValueError: if the file cannot be read, or has no triangles.
    """
    # Importing it takes a quarter of a second, and robots without meshes do without.
    import trimesh
    from trimesh.resolvers import FilePathResolver

    missing: dict[str, None] = {}

    class Files(FilePathResolver):
        def get(self, name: str) -> bytes:
            try:
                return bytes(super().get(name))
            except OSError:
                missing[name.strip()] = None
                raise

    try:
        with logged("trimesh") as messages:
            meshes = trimesh.load_scene(path, resolver=Files(str(path.parent))).dump()
    # The readers of trimesh raise errors of many kinds for damaged files and missing libraries.
    except Exception as error:
        raise ValueError(f"cannot read the mesh {path}: {error}") from error
    if lost is not None and (missing or messages):
        reason = "they are missing" if missing else messages[0]
        lost.append(f"the mesh {path.name} is read without {', '.join(missing) or 'its materials'}: {reason}")
    meshes = [mesh for mesh in meshes if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    if not meshes:
        raise ValueError(f"the mesh {path} has no triangles")
    stated = _UNIT.search(path.read_bytes()) if path.suffix.lower() == ".dae" else None
    unit = float(stated[1]) if stated else 1.0
    return [mesh.apply_scale([unit * factor for factor in scale]) for mesh in meshes]
