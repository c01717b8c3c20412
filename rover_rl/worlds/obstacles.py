"""Obstacles: static convex solids."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import groupby

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Obstacle:
    """Static convex solid.

    Args:
        vertices: points in the world frame whose convex hull is the solid, ``[V, 3]``, m. Points inside the hull are
            dropped.

    Attributes:
        faces: triangles as indices into ``vertices``, counter-clockwise from outside, ``[F, 3]``.
        planes: half-spaces ``[P, 4]``. A point ``p`` is inside if ``planes[:, :3] @ p + planes[:, 3] <= 0`` for all.

    Raises:
        ValueError: if there are fewer than four points, a point is not finite, or all points lie in one plane.
    """

    vertices: Tensor
    faces: Tensor = field(init=False)
    planes: Tensor = field(init=False)

    def __post_init__(self) -> None:
        points = np.asarray(self.vertices, dtype=np.float64)
        if points.ndim != 2 or points.shape[-1] != 3 or not np.isfinite(points).all():
            raise ValueError(f"vertices must be finite points [V, 3] in meters, got shape {points.shape}")
        try:
            hull = ConvexHull(points)
        except (QhullError, ValueError) as error:
            raise ValueError("an obstacle needs at least four points that do not lie in one plane") from error
        corners = np.unique(hull.simplices)
        renumbered = np.searchsorted(corners, hull.simplices)
        outward = hull.equations[:, :3]
        a, b, c = (points[hull.simplices[:, k]] for k in range(3))
        inward = (np.cross(b - a, c - a) * outward).sum(1) < 0
        renumbered[inward] = renumbered[inward][:, ::-1]
        object.__setattr__(self, "vertices", torch.from_numpy(points[corners]))
        object.__setattr__(self, "faces", torch.from_numpy(renumbered.astype(np.int64)))
        object.__setattr__(self, "planes", torch.from_numpy(np.unique(hull.equations.round(12), axis=0)))

    def contains(self, points: Tensor) -> Tensor:
        """Returns which of ``points [..., 3]`` (m) are inside: bool ``[...]``."""
        planes = self.planes.to(points)
        return (points @ planes[:, :3].T + planes[:, 3] <= 0).all(-1)

    @property
    def footprint(self) -> Tensor:
        """Outline from above: vertices of a convex polygon in counter-clockwise order, ``[K, 2]``, m."""
        return torch.from_numpy(_outline(self.vertices.numpy()))


@dataclass(frozen=True, eq=False)
class Solids:
    """Tensors of solids with the same number of vertices and the same faces.

    Args:
        vertices: vertices of each solid, all of them on its hull, ``[N, V, 3]``, m.
        planes: half-spaces of each solid, ``[N, P, 4]``. See :class:`Obstacle`.
        faces: triangles as indices into the vertices of a solid, ``[F, 3]``.
        outline: indices of the vertices of the footprint in counter-clockwise order, ``[K]``. ``None`` for solids that
            are not upright prisms; then there is only one solid.
    """

    vertices: Tensor
    planes: Tensor
    faces: Tensor
    outline: Tensor | None = None

    def __len__(self) -> int:
        """Number of solids."""
        return len(self.vertices)

    @property
    def outlines(self) -> np.ndarray:
        """Outlines from above, counter-clockwise, float64 ``[N, K, 2]``, m."""
        if self.outline is not None:
            return self.vertices[:, self.outline, :2].numpy()
        return np.stack([_outline(corners) for corners in self.vertices.numpy()])

    @cached_property
    def polygons(self) -> list[np.ndarray]:
        """Face polygon of each plane, as indices into the vertices of a solid, counter-clockwise from outside."""
        return _polygons(self.vertices[0].numpy(), self.planes[0].numpy())

    def obstacles(self) -> tuple[Obstacle, ...]:
        """Returns the solids one by one."""
        return tuple(_Member(self, index) for index in range(len(self.vertices)))


class _Member(Obstacle):
    """Obstacle that reads its tensors from a group of solids, without a convex hull and without a copy."""

    _solids: Solids
    _index: int

    def __init__(self, solids: Solids, index: int) -> None:
        object.__setattr__(self, "_solids", solids)
        object.__setattr__(self, "_index", index)

    @property
    def vertices(self) -> Tensor:
        return self._solids.vertices[self._index]

    @property
    def faces(self) -> Tensor:
        return self._solids.faces

    @property
    def planes(self) -> Tensor:
        return self._solids.planes[self._index]

    @property
    def footprint(self) -> Tensor:
        outline = self._solids.outline
        return super().footprint if outline is None else self.vertices[outline, :2]


def _outline(vertices: np.ndarray) -> np.ndarray:
    """Returns the outline from above of a solid with ``vertices [V, 3]``: counter-clockwise, ``[K, 2]``."""
    flat = vertices[:, :2]
    return flat[ConvexHull(flat).vertices]


def groups_of(obstacles: Sequence[Obstacle]) -> list[Solids]:
    """Returns the tensors of obstacles in groups, whose solids are the obstacles in the same order."""
    groups = []
    for key, members in groupby(obstacles, key=lambda obstacle: getattr(obstacle, "_solids", obstacle)):
        if isinstance(key, Solids):
            indices = [member._index for member in members]  # type: ignore[attr-defined]
            whole = indices == list(range(len(key)))
            groups.append(key if whole else replace(key, vertices=key.vertices[indices], planes=key.planes[indices]))
        else:
            groups += [Solids(member.vertices[None], member.planes[None], member.faces) for member in members]
    return groups


def _polygons(vertices: np.ndarray, planes: np.ndarray) -> list[np.ndarray]:
    """Returns the indices of the vertices ``[V, 3]`` on each plane ``[P, 4]``, counter-clockwise around its normal."""
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
# computed are those of Qhull, so that the results are bit-identical to Obstacle(vertices).
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
_BOX_OUTLINE = torch.tensor([0, 4, 6, 2])


def boxes(centers: ArrayLike, sizes: ArrayLike) -> tuple[Obstacle, ...]:
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
    return Solids(torch.from_numpy(vertices), torch.from_numpy(planes), _BOX_FACES, _BOX_OUTLINE).obstacles()


def cylinders(centers: ArrayLike, radii: ArrayLike, heights: ArrayLike, sides: int = 16) -> tuple[Obstacle, ...]:
    """Creates upright cylinders, approximated by prisms of ``sides`` sides whose vertices lie on the circle.

    Args:
        centers: centers ``[N, 3]``, m.
        radii: radii ``[N]``, or one for all, m.
        heights: heights ``[N]``, or one for all, m.
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
    solids = torch.from_numpy(vertices.reshape(-1, 2 * sides, 3))
    return Solids(solids, torch.from_numpy(planes), _prism_faces(sides), torch.arange(sides)).obstacles()


@lru_cache(maxsize=16)
def _prism_faces(sides: int) -> Tensor:
    """Returns the triangles of a prism whose vertices are the lower ring, then the upper one: ``[4 sides - 4, 3]``."""
    k = np.arange(sides)
    after = (k + 1) % sides
    fan = np.stack((np.zeros(sides - 2, dtype=np.int64), k[1:-1], k[2:]), -1)
    lower, upper = fan[:, ::-1], fan + sides
    first, second = np.stack((k, after, after + sides), -1), np.stack((k, after + sides, k + sides), -1)
    return torch.from_numpy(np.concatenate((lower, upper, first, second)).astype(np.int64))


def box(
    center: tuple[float, float, float],
    size: tuple[float, float, float],
    yaw: float = 0.0,
    pitch: float = 0.0,
    roll: float = 0.0,
) -> Obstacle:
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
        return boxes([center], [size])[0]
    corners = _BOX_CORNERS * np.asarray(size)
    return Obstacle(torch.from_numpy(corners @ _rotation(roll, pitch, yaw).T + np.asarray(center)))


def cylinder(center: tuple[float, float, float], radius: float, height: float, sides: int = 16) -> Obstacle:
    """Creates an upright cylinder around ``center``, with lengths in meters. See :func:`cylinders`."""
    return cylinders([center], radius, height, sides)[0]


def boulder(center: tuple[float, float, float], radius: float, rng: np.random.Generator, points: int = 24) -> Obstacle:
    """Creates a random, slightly flattened rock: the convex hull of points at 0.75 to 1 times ``radius``.

    Args:
        center: center ``(x, y, z)``, m.
        radius: maximum distance of the surface from the center, m.
        rng: random number generator.
        points: number of points.

    Raises:
        ValueError: if the radius is not positive.
    """
    if radius <= 0:
        raise ValueError(f"the radius of a boulder must be positive, got {radius}")
    directions = even_directions(points, rng.uniform(0, 2 * math.pi)) * (1.0, 1.0, 0.8)
    lengths = radius * rng.uniform(0.75, 1.0, (points, 1))
    return Obstacle(torch.from_numpy(directions * lengths + np.asarray(center)))


def even_directions(count: int, turn: float = 0.0) -> np.ndarray:
    """Returns unit vectors that are spaced evenly, as a Fibonacci sphere turned by ``turn`` (rad): ``[count, 3]``."""
    k = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * k / count), math.pi * (1 + math.sqrt(5)) * k + turn
    return np.stack((np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)), -1)


def _rotation(roll: float, pitch: float, yaw: float) -> np.ndarray:
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
