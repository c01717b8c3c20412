"""Reading of mesh files: nodes with their transforms, in meters, with z up."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, tostring

import numpy as np
import trimesh
from trimesh.resolvers import FilePathResolver

from rover_rl.native.output import logged
from rover_rl.worlds.files import optional
from rover_rl.worlds.files.contents import Piece
from rover_rl.worlds.files.options import Up
from rover_rl.worlds.files.xml_tree import read_xml, text_of

MAX_BYTES = 512 * 2**20
MAX_FACES = 5_000_000
_TO_Z_UP = {
    "x": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "z": np.eye(3),
}
"""Rotations that turn the axis that points up into z. COLLADA 1.4.1 defines the two other axes of each."""
_WHITE_PIXEL = b"P6 1 1 255 \xff\xff\xff"
"""A picture in the format PPM."""


def read_mesh(path: Path, up: Up = "auto", scale: float = 1.0) -> list[Piece]:
    """Reads a mesh file: a piece for each node with triangles. See :class:`ImportOptions` for ``up`` and ``scale``."""
    data = _read(path)
    kind = path.suffix.lower()
    unit, axis = 1.0, "y" if kind in (".glb", ".gltf") else "z"
    names: set[str] = set()
    if kind == ".dae":
        root = read_xml(path, data)
        unit, axis = _collada_frame(path, root)
        names = _named_by_nodes(root)
        data = _standard_xml(root)
    if kind == ".gltf":
        _check_json(path, data)
    turn = np.eye(4)
    turn[:3, :3] = scale * unit * _TO_Z_UP[axis if up == "auto" else up]
    pieces = []
    scene = _load(path, data)
    base = scene.graph.base_frame
    if scene.graph.transforms.parents.get(base, base) != base:
        # trimesh 4 takes the node for its base frame, and loses the transforms above it.
        raise ValueError(f"{path} has a node {base!r} below another one; give it another name")
    for node in sorted(scene.graph.nodes_geometry):
        frame: Any = scene.graph[node]
        transform, name = frame
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            # trimesh numbers the parts of a geometry of COLLADA that have materials of their own.
            whole = str(node).rpartition("_")[0]
            part = whole if whole in names and node not in names else str(node)
            pieces.append(Piece(part, np.asarray(mesh.vertices), np.asarray(mesh.faces), turn @ transform))
    if not pieces:
        raise ValueError(f"{path} holds no triangles")
    if sum(len(piece.faces) for piece in pieces if piece.faces is not None) > MAX_FACES:
        raise ValueError(f"{path} has more than {MAX_FACES:,} triangles; simplify it first")
    return pieces


def _read(path: Path) -> bytes:
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path} has more than {MAX_BYTES >> 20} MB; simplify it first")
    return path.read_bytes()


def _load(path: Path, data: bytes) -> trimesh.Scene:
    if path.suffix.lower() == ".dae":
        optional("collada")
    kind, resolver = path.suffix.lower()[1:], _FolderResolver(str(path.parent))
    try:
        # A missing material is of no interest, and a damaged file is told in one sentence.
        with logged("trimesh"):
            return trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=resolver, process=False)
    except MemoryError as error:
        raise ValueError(f"{path} asks for more memory than there is; it may be damaged") from error
    # The readers raise errors of all kinds for a damaged file.
    except Exception as error:
        reason = str(error) if isinstance(error, (OSError, _LeavesError)) else f"{type(error).__name__}: {error}"
        raise ValueError(f"{path} cannot be read as a mesh: {reason.splitlines()[0][:200]}") from error


class _LeavesError(ValueError):
    """A mesh names a file outside of its folder."""


class _FolderResolver(FilePathResolver):
    """Gives the mesh readers the geometry in the files of one folder, and nothing for materials and textures."""

    def get(self, name: str) -> bytes:
        """Returns the content of a file with geometry, such as a glTF buffer."""
        path = Path(os.path.abspath(Path(self.parent) / name.strip()))
        if path.suffix.lower() not in (".bin", ".glb"):
            # Materials and pictures are no geometry, and often missing: they are empty, and white.
            return b"" if path.suffix.lower() == ".mtl" else _WHITE_PIXEL
        if "://" in name or not path.is_relative_to(self.parent):
            raise _LeavesError(f"{name} is outside of its folder")
        return _read(path)


def _check_json(path: Path, data: bytes) -> None:
    """Checks that the buffers of a glTF file are local, before anything reads them."""
    try:
        buffers = json.loads(data)["buffers"]
        names = [str(buffer.get("uri", "")) for buffer in buffers]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path} cannot be read as a mesh: it is no glTF with buffers") from error
    outside = [name for name in names if "://" in name or name.startswith("/") or ".." in Path(name).parts]
    if outside:
        raise ValueError(f"{path} names {outside[0]}, which is outside of its folder")


def _collada_frame(path: Path, root: Element) -> tuple[float, str]:
    """Returns the unit (m) and the axis that points up of a COLLADA file."""
    asset = root.find("asset")
    unit, axis = 1.0, "y"
    if asset is not None:
        element = asset.find("unit")
        text = "1" if element is None else element.get("meter", "1")
        try:
            unit = float(text)
        except ValueError:
            unit = float("nan")
        if not 1e-6 <= unit <= 1e6:
            raise ValueError(f"the unit of {path} must be a positive number of meters, got {text!r}")
        # COLLADA 1.4.1: without up_axis, y points up.
        axis = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}.get(text_of(asset.find("up_axis")), "y")
    return unit, axis


def _named_by_nodes(root: Element) -> set[str]:
    """Gives geometries of COLLADA that one node shows the name of that node, and returns the names of all."""
    shown: dict[str, list[tuple[Element, str]]] = {}
    for node in root.iter("node"):
        for instance in node.findall("instance_geometry"):
            shown.setdefault(instance.get("url", "")[1:], []).append((instance, node.get("name", "")))
    geometries = {geometry.get("id", ""): geometry for geometry in root.iter("geometry")}
    names = {*geometries}
    for key, geometry in geometries.items():
        (instance, name), *others = shown.get(key, [(root, "")])
        if name and not others and name not in names:
            geometry.set("id", name)
            instance.set("url", f"#{name}")
            names.add(name)
    return names


def _standard_xml(root: Element) -> bytes:
    """Returns XML for readers that want all prefixes declared: only extras of the exporters have any."""
    for element in root.iter():
        element.tag = element.tag.replace(":", ".")
        element.attrib = {name: value for name, value in element.attrib.items() if ":" not in name}
    return tostring(root)
