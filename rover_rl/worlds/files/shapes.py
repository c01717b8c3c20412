"""Shapes of SDF as points, triangles, planes and grids."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from rover_rl.tiny_xml import is_true, numbers, text_of
from rover_rl.worlds.files import MESH_SUFFIXES, TIFF_SUFFIXES, optional
from rover_rl.worlds.files.contents import Contents, Grid, Piece, Plane
from rover_rl.worlds.files.elevation import read_elevations
from rover_rl.worlds.files.locate import Locator
from rover_rl.worlds.files.mesh_files import read_mesh
from rover_rl.worlds.files.options import MAX_SIZE
from rover_rl.worlds.files.triangles import merge_triangles

TOLERANCE = 0.005
"""Largest distance between a round shape and the polygon in its place, m."""
SIDES = (12, 96)
"""Least and largest number of sides of a polygon in place of a circle."""
UPRIGHT = math.cos(math.radians(60))
"""Least z component of the normal of a plane that is ground."""


class ShapeReader:
    """Adds the shapes of an SDF file to its contents."""

    def __init__(self, contents: Contents, locator: Locator) -> None:
        self._contents, self._locator = contents, locator
        self._meshes: dict[Path, list[Piece]] = {}

    def add(self, geometry: Element, transform: np.ndarray, name: str, folder: Path) -> None:
        """Adds the shape in a ``<geometry>``, by its pose in the world, ``[4, 4]``, and the folder of its file."""
        for shape in geometry:
            if shape.tag == "plane":
                self._plane(shape, transform, name)
            elif shape.tag == "heightmap":
                self._heightmap(shape, transform, name, folder)
            elif shape.tag == "mesh":
                self._mesh(shape, transform, name, folder)
            elif shape.tag in _SOLIDS or shape is geometry.find("polyline"):
                what = f"the {shape.tag} of {name}"
                solids = (
                    _SOLIDS[shape.tag](shape, what)
                    if shape.tag in _SOLIDS
                    else _polylines(geometry.findall("polyline"), what)
                )
                self._contents.pieces += [Piece(name, _moved(points, transform)) for points in solids]
            elif shape.tag not in ("empty", "polyline"):
                self._contents.left_out.append(f"{name}: shapes of the kind <{shape.tag}> are left out")

    def _plane(self, shape: Element, transform: np.ndarray, name: str) -> None:
        normal = numbers(shape.find("normal"), 3, (0, 0, 1), f"the normal of {name}")
        size = numbers(shape.find("size"), 2, (1, 1), f"the size of {name}")
        if np.linalg.norm(normal) < 1e-9:
            raise ValueError(f"the normal of {name} must not be 0")
        normal = np.linalg.inv(transform[:3, :3]).T @ normal
        normal /= np.linalg.norm(normal)
        if normal[2] < UPRIGHT:
            self._contents.left_out.append(f"{name}: a plane that is steeper than 60 degrees is left out")
            return
        if normal[2] > 1 - 1e-9:
            normal = np.array((0.0, 0.0, 1.0))
        point = Piece(name, transform[None, :3, 3]).vertices[0]
        self._contents.planes.append(Plane(point, normal, (float(abs(size[0])), float(abs(size[1])))))

    def _mesh(self, shape: Element, transform: np.ndarray, name: str, folder: Path) -> None:
        path = self._find(shape, folder, name)
        if path is None:
            return
        if path.suffix.lower() not in MESH_SUFFIXES:
            raise ValueError(f"{path} is no mesh; use one of {[*MESH_SUFFIXES]}")
        scale = numbers(shape.find("scale"), 3, (1, 1, 1), f"the scale of {name}")
        if (scale == 0).any():
            raise ValueError(f"the scale of {name} must not be 0")
        if path not in self._meshes:
            # Gazebo takes the coordinates of a mesh as they are, whichever axis its format has up; the unit counts.
            self._meshes[path] = read_mesh(path, up="z")
        pieces = self._meshes[path]
        submesh = shape.find("submesh")
        if submesh is not None:
            wanted = text_of(submesh.find("name"))
            pieces = [piece for piece in pieces if piece.name == wanted]
            if not pieces:
                names = sorted({piece.name for piece in self._meshes[path]})
                raise ValueError(f"{path} has no submesh {wanted!r} for {name}; it has {names[:20]}")
            if is_true(submesh.find("center")):
                points = np.concatenate([piece.vertices for piece in pieces])
                transform = transform @ _translation(-scale * (points.min(0) + points.max(0)) / 2)
        transform = transform @ np.diag((*scale, 1.0))
        self._contents.pieces += [
            Piece(f"{name}/{piece.name}", piece.points, piece.faces, transform @ piece.pose) for piece in pieces
        ]

    def _heightmap(self, shape: Element, transform: np.ndarray, name: str, folder: Path) -> None:
        """Adds an elevation map as Gazebo does: the outermost values at the ends of ``size``, the first row at +y.

        Pictures are scaled so that the brightest pixel is as high as ``size`` says, and elevation models about their
        lowest point so that their range is that high (gz-common: ``ImageHeightmap::FillHeightMap``,
        ``Dem::FillHeightMap``; gz-physics: ``CustomHeightmapShape``).
        """
        path = self._find(shape, folder, name)
        if path is None:
            return
        size = numbers(shape.find("size"), 3, (1, 1, 1), f"the size of {name}")
        if min(size[:2]) <= 0 or np.abs(size).max() > 2 * MAX_SIZE:
            raise ValueError(f"the size of {name} must be positive and at most {2 * MAX_SIZE:g} m, got {size.tolist()}")
        if abs(transform[2, 2] - 1) > 1e-6:
            raise ValueError(f"the elevation map of {name} is tilted, which is not supported")
        found = read_elevations(path)
        values = found.values[::-1]
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        if path.suffix.lower() in TIFF_SUFFIXES:
            values = low + (values - low) * (abs(size[2]) / (high - low) if high > low else 1.0)
        else:
            values = values / (high if high > 0 else 1.0) * size[2]
        rows, columns = values.shape
        offset = numbers(shape.find("pos"), 3, (0, 0, 0), f"the pos of {name}")
        corner = transform @ np.array([offset[0] - size[0] / 2, offset[1] - size[1] / 2, offset[2], 1.0])
        Piece(name, corner[None, :3])
        cell = float(size[0]) / (columns - 1), float(size[1]) / (rows - 1)
        yaw = math.atan2(transform[1, 0], transform[0, 0])
        self._contents.grids.append(Grid(values + corner[2], cell, (float(corner[0]), float(corner[1])), yaw))

    def _find(self, shape: Element, folder: Path, name: str) -> Path | None:
        uri = text_of(shape.find("uri"))
        if not uri:
            raise ValueError(f"the {shape.tag} of {name} has no uri")
        return self._locator.file(uri, folder)


def _moved(points: np.ndarray, transform: np.ndarray) -> np.ndarray:
    return points @ transform[:3, :3].T + transform[:3, 3]


def _translation(offset: np.ndarray) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, 3] = offset
    return transform


def _lengths(shape: Element, key: str, count: int, what: str) -> np.ndarray:
    """Returns positive lengths, m."""
    values = numbers(shape.find(key), count, None, f"the {key} of {what}")
    if not ((values > 0) & (values <= 2 * MAX_SIZE)).all():
        raise ValueError(f"the {key} of {what} must be positive and at most {2 * MAX_SIZE:g} m, got {values.tolist()}")
    return values


def _sides(radius: float) -> int:
    wanted = math.pi / math.acos(max(0.0, 1 - TOLERANCE / radius)) if radius > TOLERANCE else 0
    return 4 * math.ceil(min(max(wanted, SIDES[0]), SIDES[1]) / 4)


def _circle(radius: float, height: float) -> np.ndarray:
    turn = 2 * math.pi * np.arange(_sides(radius)) / _sides(radius)
    return np.stack((radius * np.cos(turn), radius * np.sin(turn), np.full(len(turn), height)), -1)


def _ball(radius: float) -> np.ndarray:
    around = min(_sides(radius), 32)
    latitudes = np.arange(-(around // 4), around // 4 + 1) * (2 * math.pi / around)
    turn = 2 * math.pi * np.arange(around) / around
    rings = [
        np.stack((np.cos(a) * np.cos(turn), np.cos(a) * np.sin(turn), np.full(around, np.sin(a))), -1)
        for a in latitudes[1:-1]
    ]
    return radius * np.concatenate((*rings, [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]))


def _box(shape: Element, what: str) -> list[np.ndarray]:
    size = _lengths(shape, "size", 3, what)
    return [np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size]


def _sphere(shape: Element, what: str) -> list[np.ndarray]:
    (radius,) = _lengths(shape, "radius", 1, what)
    return [_ball(radius)]


def _ellipsoid(shape: Element, what: str) -> list[np.ndarray]:
    radii = _lengths(shape, "radii", 3, what)
    return [_ball(radii.max()) / radii.max() * radii]


def _round(shape: Element, what: str) -> list[np.ndarray]:
    (radius,), (length,) = _lengths(shape, "radius", 1, what), _lengths(shape, "length", 1, what)
    half = length / 2
    if shape.tag == "cylinder":
        parts = (_circle(radius, -half), _circle(radius, half))
    elif shape.tag == "cone":
        parts = (_circle(radius, -half), np.array([[0.0, 0.0, half]]))
    else:
        ball = _ball(radius)
        parts = (ball[ball[:, 2] >= -1e-9] + (0, 0, half), ball[ball[:, 2] <= 1e-9] - (0, 0, half))
    return [np.concatenate(parts)]


def _polylines(shapes: list[Element], what: str) -> list[np.ndarray]:
    earcut = optional("mapbox_earcut")
    rings = [_ring(shape, what) for shape in shapes]
    (height,) = _lengths(shapes[0], "height", 1, what)
    around = [{k for k, other in enumerate(rings) if other is not ring and _contains(other, ring[0])} for ring in rings]
    prisms = []
    for n, ring in enumerate(rings):
        if len(around[n]) % 2:
            continue
        parts = [ring, *(rings[k] for k, outer in enumerate(around) if outer == {*around[n], n})]
        points, ends = np.concatenate(parts), np.cumsum([len(part) for part in parts])
        triangles = np.asarray(earcut.triangulate_float64(points, ends.astype(np.uint32))).reshape(-1, 3)
        if not len(triangles):
            raise ValueError(f"{what} has no area")
        prisms += [
            np.concatenate([np.column_stack((points[polygon], np.full(len(polygon), z))) for z in (0.0, height)])
            for polygon in merge_triangles(points, triangles)
        ]
    return prisms


def _ring(shape: Element, what: str) -> np.ndarray:
    """Returns the corners of a polygon ``[P, 2]``, m."""
    points = np.array([numbers(point, 2, None, f"a point of {what}") for point in shape.findall("point")])
    if len(points) > 1 and np.allclose(points[0], points[-1]):
        points = points[:-1]
    if len(points) < 3:
        raise ValueError(f"{what} must have at least 3 points, got {len(points)}")
    return points


def _contains(ring: np.ndarray, point: np.ndarray) -> bool:
    (x, y), following = (ring - point).T, np.roll(ring - point, -1, 0)
    up, down = following[:, 1] > 0, y > 0
    side = x * following[:, 1] - following[:, 0] * y
    return bool(((up != down) & ((side > 0) == up)).sum() % 2)


_SOLIDS = {
    "box": _box,
    "cylinder": _round,
    "cone": _round,
    "capsule": _round,
    "sphere": _sphere,
    "ellipsoid": _ellipsoid,
}
"""Functions that return the points of convex solids, by the tag of their shape."""
