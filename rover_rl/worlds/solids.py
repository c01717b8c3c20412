"""Solids: tables of static convex solids, and functions that make them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import groupby

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Shape:
    """Numbers of vertices and planes of a solid, and how they are joined, which boxes, for example, have in common.

    ``faces`` are triangles ``[F, 3]`` as indices of vertices, and ``outline`` those of the outline from above, both
    counter-clockwise from outside. It depends on the vertices if it is ``None``.
    """

    vertices: int
    planes: int
    faces: Tensor
    outline: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Solids(Sequence["Solids"]):
    """Convex solids, one after the other in tables. Its items are the solids, each a table with one of them.

    ``hull``, ``box``, ``boxes``, ``cylinder``, ``cylinders`` and ``boulder`` make them.

    Args:
        vertices: vertices of all solids, all of them on the hull of theirs, float64 ``[V, 3]``, m.
        planes: half-spaces of all solids, float64 ``[P, 4]``. A point ``p`` is inside of a solid if
            ``planes[:, :3] @ p + planes[:, 3] <= 0`` for all of its planes.
        shapes: shape of each solid.

    Example:
        >>> solids = Solids.of([box((0, 0, 1), (2, 2, 2)), cylinder((3, 0, 1), radius=0.5, height=2)])
        >>> len(solids), solids[0].contains(torch.tensor([[0.5, 0.5, 0.5], [3.0, 0.0, 1.0]]))
        (2, tensor([ True, False]))
    """

    vertices: Tensor
    planes: Tensor
    shapes: tuple[Shape, ...]

    @classmethod
    def of(cls, parts: Iterable[Solids]) -> Solids:
        """Joins tables. Returns a table unchanged."""
        if isinstance(parts, Solids):
            return parts
        parts = [*parts]
        vertices = torch.cat([torch.empty((0, 3), dtype=torch.float64), *(part.vertices for part in parts)])
        planes = torch.cat([torch.empty((0, 4), dtype=torch.float64), *(part.planes for part in parts)])
        return cls(vertices, planes, tuple(shape for part in parts for shape in part.shapes))

    def __len__(self) -> int:
        return len(self.shapes)

    def __getitem__(self, index: int | slice) -> Solids:
        if isinstance(index, slice):
            return Solids.of([self[k] for k in range(*index.indices(len(self)))])
        index = range(len(self))[index]
        vertices, planes = (slice(starts[index], starts[index + 1]) for starts in (self.starts, self.plane_starts))
        return Solids(self.vertices[vertices], self.planes[planes], (self.shapes[index],))

    @cached_property
    def starts(self) -> list[int]:
        """Index of the first vertex of each solid, and the number of all vertices."""
        return np.cumsum([0, *(shape.vertices for shape in self.shapes)]).tolist()

    @cached_property
    def plane_starts(self) -> list[int]:
        """Index of the first plane of each solid, and the number of all planes."""
        return np.cumsum([0, *(shape.planes for shape in self.shapes)]).tolist()

    @property
    def faces(self) -> Tensor:
        """Triangles of all solids as indices into ``vertices``, counter-clockwise from outside, ``[F, 3]``."""
        faces = [shape.faces + start for shape, start in zip(self.shapes, self.starts[:-1], strict=True)]
        return torch.cat([torch.empty((0, 3), dtype=torch.int64), *faces])

    @cached_property
    def bounding_boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of the bounding box of each solid, float64 ``[N, 3]``, m."""
        if not self.shapes:
            return np.empty((0, 3)), np.empty((0, 3))
        low, high = (ends.reduceat(self.vertices.numpy(), self.starts[:-1]) for ends in (np.minimum, np.maximum))
        return low, high

    @cached_property
    def outlines(self) -> list[np.ndarray]:
        """Outline from above of each solid: a convex polygon, counter-clockwise, float64 ``[K, 2]``, m."""
        found, start = list[np.ndarray](), 0
        flat = self.vertices[:, :2].numpy()
        for shape, members in groupby(self.shapes):
            count = len([*members])
            points = flat[start : start + count * shape.vertices].reshape(count, -1, 2)
            start += count * shape.vertices
            if shape.outline is None:
                found += [corners[ConvexHull(corners).vertices] for corners in points]
            else:
                found += [*points[:, shape.outline.numpy()]]
        return found

    @property
    def footprint(self) -> Tensor:
        """Outline of the only solid, ``[K, 2]``, m."""
        return torch.from_numpy(*self.outlines)

    def contains(self, points: Tensor) -> Tensor:
        """Returns which of ``points [..., 3]`` (m) are inside of a solid: bool ``[...]``."""
        inside = torch.zeros(points.shape[:-1], dtype=torch.bool, device=points.device)
        planes = self.planes.to(points)
        for first, end in zip(self.plane_starts[:-1], self.plane_starts[1:], strict=True):
            inside |= (points @ planes[first:end, :3].T + planes[first:end, 3] <= 0).all(-1)
        return inside


def hull(vertices: Tensor | ArrayLike) -> Solids:
    """Creates the convex hull of points ``[V, 3]``, m. Those inside of it are dropped.

    Raises:
        ValueError: if there are fewer than four points, a point is not finite, or all points lie in one plane.
    """
    points = np.asarray(vertices, dtype=np.float64)
    if points.ndim != 2 or points.shape[-1] != 3 or not np.isfinite(points).all():
        raise ValueError(f"vertices must be finite points [V, 3] in meters, got shape {points.shape}")
    try:
        found = ConvexHull(points)
    except (QhullError, ValueError) as error:
        raise ValueError("an obstacle needs at least four points that do not lie in one plane") from error
    corners = np.unique(found.simplices)
    faces = np.searchsorted(corners, found.simplices)
    a, b, c = (points[found.simplices[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * found.equations[:, :3]).sum(1) < 0
    faces[inward] = faces[inward][:, ::-1]
    planes = torch.from_numpy(np.unique(found.equations.round(12), axis=0))
    shape = Shape(len(corners), len(planes), torch.from_numpy(faces.astype(np.int64)))
    return Solids(torch.from_numpy(points[corners]), planes, (shape,))


def bounding_balls(points: np.ndarray, starts: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Middles ``[N, D]`` and radii ``[N]`` of balls around points ``[V, D]`` from each start to the next one."""
    counts = np.diff(starts)
    middles = np.add.reduceat(points, starts[:-1]) / counts[:, None]
    return middles, np.maximum.reduceat(np.linalg.norm(points - middles.repeat(counts, 0), axis=1), starts[:-1])


def face_polygons(solid: Solids) -> list[np.ndarray]:
    """Returns the vertices on each plane of one solid, as indices counter-clockwise from outside."""
    vertices, planes = solid.vertices.numpy(), solid.planes.numpy()
    normals = planes[:, :3]
    on = np.abs(normals @ vertices.T + planes[:, 3:]) < 1e-6
    counts = on.sum(1)
    middles = (on[..., None] * vertices).sum(1) / counts[:, None]
    # Angles around the middle of the polygon, from the direction to its first vertex.
    first = vertices[on.argmax(1)] - middles
    second = np.cross(normals, first)
    offsets = vertices - middles[:, None]
    angles = np.arctan2((offsets @ second[..., None])[..., 0], (offsets @ first[..., None])[..., 0])
    order = np.argsort(np.where(on, angles, np.inf), axis=1)
    return [row[:count] for row, count in zip(order, counts.tolist(), strict=True)]


_BOX_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
# The order of the faces and planes, the signs of the zeros, and the corners from which the offsets of the planes are
# computed are those of Qhull, so that the results are bit-identical to hull(vertices).
_BOX_FACES = torch.tensor(
    [
        [(0, 2, 6), (6, 4, 0), (0, 4, 5), (5, 1, 0), (4, 6, 5), (5, 6, 7)],
        [(3, 2, 0), (0, 1, 3), (3, 6, 2), (7, 6, 3), (1, 5, 3), (3, 5, 7)],
    ]
).reshape(12, 3)
_BOX_NORMALS = np.array(
    [[-1.0, -0.0, -0.0], [0.0, -1.0, 0.0], [-0.0, -0.0, -1.0], [-0.0, -0.0, 1.0], [0.0, 1.0, -0.0], [1.0, -0.0, -0.0]]
)
_BOX_PLANE_CORNERS = (0, 0, 2, 1, 2, 4)
_BOX = Shape(8, 6, _BOX_FACES, torch.tensor([0, 4, 6, 2]))


def boxes(centers: ArrayLike, sizes: ArrayLike) -> Solids:
    """Creates boxes whose sides are parallel to the axes. Much faster than :func:`box` for many of them.

    Args:
        centers: centers ``[N, 3]``, m.
        sizes: side lengths along x, y and z, ``[N, 3]`` or ``[3]``, m.

    Raises:
        ValueError: if a number is not finite or a side length is not positive.
    """
    center = np.asarray(centers, dtype=np.float64).reshape(-1, 3)
    size = np.broadcast_to(np.asarray(sizes, dtype=np.float64), center.shape)
    if not (np.isfinite(center).all() and np.isfinite(size).all() and (size > 0).all()):
        raise ValueError("boxes need finite centers and positive side lengths in meters")
    vertices = _BOX_CORNERS * size[:, None] + center[:, None]
    on_plane = _BOX_NORMALS * vertices[:, _BOX_PLANE_CORNERS]
    offsets = -(on_plane[..., 0] + on_plane[..., 1] + on_plane[..., 2])
    normals = np.broadcast_to(_BOX_NORMALS, (len(center), 6, 3))
    planes = np.concatenate((normals, offsets[..., None]), -1).round(12)
    return _alike(_BOX, vertices, planes)


def cylinders(centers: ArrayLike, radii: ArrayLike, heights: ArrayLike, sides: int = 16) -> Solids:
    """Creates upright cylinders, approximated by prisms of ``sides`` sides whose vertices lie on the circle.

    Args:
        centers: centers ``[N, 3]``, m.
        radii, heights: ``[N]``, or one for all, m.
        sides: number of sides of the prisms.

    Raises:
        ValueError: if a number is not finite, a radius or height not positive, or there are fewer than three sides.
    """
    center = np.asarray(centers, dtype=np.float64).reshape(-1, 3)
    radius, height = (np.broadcast_to(np.asarray(v, dtype=np.float64), len(center))[:, None] for v in (radii, heights))
    finite = np.isfinite(center).all() and np.isfinite(radius).all() and np.isfinite(height).all()
    if not finite or (radius <= 0).any() or (height <= 0).any() or sides < 3:
        raise ValueError(f"a cylinder needs radius > 0, height > 0, sides >= 3; got {radii!r}, {heights!r}, {sides}")
    turn = 2 * math.pi * np.arange(sides) / sides
    vertices = np.empty((len(center), 2, sides, 3))
    vertices[..., 0] = (radius * np.cos(turn))[:, None]
    vertices[..., 1] = (radius * np.sin(turn))[:, None]
    vertices[:, 0, :, 2], vertices[:, 1, :, 2] = -height / 2, height / 2
    vertices += center[:, None, None]
    # The sides' normals point between the vertices, where the distance from the axis is the apothem.
    middle = turn + math.pi / sides
    normals = np.stack((np.cos(middle), np.sin(middle)), -1)
    planes = np.zeros((len(center), sides + 2, 4))
    planes[:, :sides, :2] = normals
    planes[:, :sides, 3] = -(center[:, :2] @ normals.T) - radius * math.cos(math.pi / sides)
    planes[:, sides, 2], planes[:, sides + 1, 2] = -1.0, 1.0
    planes[:, sides, 3], planes[:, sides + 1, 3] = vertices[:, 0, 0, 2], -vertices[:, 1, 0, 2]
    return _alike(_prism(sides), vertices, planes)


def _alike(shape: Shape, vertices: np.ndarray, planes: np.ndarray) -> Solids:
    tables = torch.from_numpy(vertices.reshape(-1, 3)), torch.from_numpy(planes.reshape(-1, 4))
    # Where the polygons of faces begin depends on rounding: only solids that are made together have the same.
    return Solids(*tables, (replace(shape),) * len(planes))


@lru_cache(maxsize=16)
def _prism(sides: int) -> Shape:
    k = np.arange(sides)
    after = (k + 1) % sides
    fan = np.stack((np.zeros(sides - 2, dtype=np.int64), k[1:-1], k[2:]), -1)
    lower, upper = fan[:, ::-1], fan + sides
    first, second = np.stack((k, after, after + sides), -1), np.stack((k, after + sides, k + sides), -1)
    faces = torch.from_numpy(np.concatenate((lower, upper, first, second)).astype(np.int64))
    return Shape(2 * sides, sides + 2, faces, torch.arange(sides))


def box(
    center: tuple[float, float, float],
    size: tuple[float, float, float],
    yaw: float = 0.0,
    pitch: float = 0.0,
    roll: float = 0.0,
) -> Solids:
    """Creates a box.

    Args:
        center: center ``(x, y, z)``, m.
        size: side lengths along x, y and z before the rotation, m.
        yaw, pitch, roll: rotations about the fixed z, y and x axis, rad. Roll is applied first, yaw last.

    Raises:
        ValueError: if a number is not finite or a side length is not positive.
    """
    if min(size) <= 0:
        raise ValueError(f"the sides of a box must be positive lengths in meters, got {tuple(size)}")
    if yaw == pitch == roll == 0:
        return boxes([center], [size])
    corners = _BOX_CORNERS * np.asarray(size)
    turn = Rotation.from_euler("xyz", (roll, pitch, yaw))
    return hull(turn.apply(corners) + np.asarray(center))


def cylinder(center: tuple[float, float, float], radius: float, height: float, sides: int = 16) -> Solids:
    """Creates an upright cylinder as :func:`cylinders` does."""
    return cylinders([center], radius, height, sides)


def boulder(center: tuple[float, float, float], radius: float, rng: np.random.Generator, points: int = 24) -> Solids:
    """Creates a random, slightly flattened rock: the hull of points at 0.75 to 1 times ``radius`` (m) from the center.

    Raises:
        ValueError: if the radius is not positive.
    """
    if radius <= 0:
        raise ValueError(f"the radius of a boulder must be positive, got {radius}")
    directions = even_directions(points, rng.uniform(0, 2 * math.pi)) * (1.0, 1.0, 0.8)
    lengths = radius * rng.uniform(0.75, 1.0, (points, 1))
    return hull(directions * lengths + np.asarray(center))


def even_directions(count: int, turn: float = 0.0) -> np.ndarray:
    """Returns unit vectors that are spaced evenly, as a Fibonacci sphere turned by ``turn`` (rad): ``[count, 3]``."""
    k = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * k / count), math.pi * (1 + math.sqrt(5)) * k + turn
    return np.stack((np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)), -1)
