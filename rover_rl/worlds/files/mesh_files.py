"""Reading of mesh files: nodes with their transforms, in meters, with z up."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, tostring

import numpy as np
import trimesh
from trimesh.resolvers import FilePathResolver

from rover_rl.native.output import logged
from rover_rl.tiny_xml import read_xml, text_of
from rover_rl.worlds.files.contents import Piece
from rover_rl.worlds.files.options import Up, optional

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
    kind, data = path.suffix.lower(), path.read_bytes()
    unit, axis = 1.0, "y" if kind in (".glb", ".gltf") else "z"
    names: set[str] = set()
    if kind == ".dae":
        optional("collada")
        root = read_xml(path)
        unit, axis = _collada_frame(path, root)
        names = _name_by_nodes(root)
        for element in root.iter():
            # Standard XML needs a declaration of prefixes.
            element.tag = element.tag.replace(":", ".")
            element.attrib = {name: value for name, value in element.attrib.items() if ":" not in name}
        data = tostring(root)
    turn = np.eye(4)
    turn[:3, :3] = scale * unit * _TO_Z_UP[axis if up == "auto" else up]
    scene = _load(path, data)
    base = scene.graph.base_frame
    if scene.graph.transforms.parents.get(base, base) != base:
        # trimesh 4 takes the node for its base frame, and loses the transforms above it.
        raise ValueError(f"{path} has a node {base!r} below another one; give it another name")
    pieces = []
    for node in sorted(map(str, scene.graph.nodes_geometry)):
        frame: Any = scene.graph[node]
        transform, name = frame
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            # trimesh numbers the parts of a geometry of COLLADA that have materials of their own.
            whole = node.rpartition("_")[0]
            part = whole if whole in names and node not in names else node
            pieces.append(Piece(part, np.asarray(mesh.vertices), np.asarray(mesh.faces), turn @ transform))
    if not pieces:
        raise ValueError(f"{path} holds no triangles")
    if sum(len(mesh.faces) for mesh in scene.geometry.values() if isinstance(mesh, trimesh.Trimesh)) > MAX_FACES:
        raise ValueError(f"{path} has more than {MAX_FACES:,} triangles; simplify it first")
    return pieces


class _GeometryResolver(FilePathResolver):
    """Leaves out materials and textures, which are no geometry, and often missing."""

    def get(self, name: str) -> bytes:
        suffix = Path(name.strip()).suffix.lower()
        if suffix in (".bin", ".glb"):
            return super().get(name.strip())
        return b"" if suffix == ".mtl" else _WHITE_PIXEL


def _load(path: Path, data: bytes) -> trimesh.Scene:
    kind, resolver = path.suffix.lower()[1:], _GeometryResolver(str(path.parent))
    try:
        with logged("trimesh"):
            return trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=resolver, process=False)
    # The readers raise errors of all kinds for a damaged file.
    except Exception as error:
        reason = str(error) if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        raise ValueError(f"{path} cannot be read as a mesh: {reason.splitlines()[0][:200]}") from error


def _collada_frame(path: Path, root: Element) -> tuple[float, str]:
    """Returns the unit (m) and the axis that points up of a COLLADA file."""
    element = root.find("asset/unit")
    text = "1" if element is None else element.get("meter", "1")
    try:
        unit = float(text)
    except ValueError:
        unit = float("nan")
    if not 1e-6 <= unit <= 1e6:
        raise ValueError(f"the unit of {path} must be a positive number of meters, got {text!r}")
    # COLLADA 1.4.1: without up_axis, y points up.
    return unit, {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}.get(text_of(root.find("asset/up_axis")), "y")


def _name_by_nodes(root: Element) -> set[str]:
    """Gives geometries that one node alone shows its name, which trimesh ignores. Returns the names."""
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
