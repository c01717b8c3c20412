"""What a robot is made of: masses, boxes and shapes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

Vector: TypeAlias = tuple[float, float, float]


class Frame(NamedTuple):
    """Pose in a parent frame: origin ``[3]``, m, and rotation matrix ``[3, 3]``, whose columns are the axes."""

    position: np.ndarray
    rotation: np.ndarray

    @property
    def is_turned(self) -> bool:
        return not np.array_equal(self.rotation, np.eye(3))

    def __matmul__(self, inner: Frame) -> Frame:
        """The pose in the parent frame of ``inner``, which is relative to this frame."""
        return Frame(self.position + self.rotation @ inner.position, self.rotation @ inner.rotation)


HERE = Frame(np.zeros(3), np.eye(3))


class Shape(NamedTuple):
    """Shape of a robot: ``"box"``, ``"cylinder"`` (along z), ``"sphere"``, ``"mesh"``, or another element of a URDF.

    ``sizes`` are x, y, z of a box; radius, length of a cylinder; the radius of a sphere, m; or the factors of the
    coordinates of a mesh, whose ``file`` is as the URDF states it. ``color`` is red, green and blue, 0 to 1.
    """

    kind: str
    frame: Frame
    sizes: tuple[float, ...]
    file: str = ""
    color: tuple[float, ...] | None = None


class Mass(NamedTuple):
    """Mass, kg, center of mass, m, and inertia about it, rows of a matrix, kg m^2."""

    mass: float
    center: Vector
    inertia: tuple[Vector, Vector, Vector]

    @classmethod
    def of(cls, mass: float, center: np.ndarray, inertia: np.ndarray) -> Mass:
        first, second, third = map(tuple, inertia.tolist())
        return cls(float(mass), tuple(center.tolist()), (first, second, third))

    @property
    def is_rigid(self) -> bool:
        """Whether a rigid body may have this inertia: no moment exceeds the sum of the others by more than 1 %."""
        moments = np.linalg.eigvalsh(self.inertia)
        return bool(moments[0] > 0 and moments[2] <= 1.01 * (moments[0] + moments[1]))

    def without(self, other: Mass) -> Mass:
        """The rest of a body without one of its parts."""
        mass, center, own = self.mass - other.mass, np.array(self.center), np.array(other.center)
        rest = (self.mass * center - other.mass * own) / mass
        inertia = np.array(self.inertia) + point_inertia(self.mass, center - rest)
        return Mass.of(mass, rest, inertia - other.inertia - point_inertia(other.mass, own - rest))


WEIGHTLESS = Mass(0.0, (0.0, 0.0, 0.0), ((0.0, 0.0, 0.0),) * 3)


class Box(NamedTuple):
    """Box along the axes of the base frame: center and side lengths, m.

    ``mass`` is ``None`` for a box on the link of the body, else that of its own link: Bullet computes links one by one.
    """

    center: Vector
    size: Vector
    mass: Mass | None = None

    @classmethod
    def between(cls, low: np.ndarray, high: np.ndarray) -> Box:
        """A box by its lowest and highest corner, whose mass is that of other links."""
        return cls(tuple(((low + high) / 2).tolist()), tuple((high - low).tolist()), WEIGHTLESS)


def point_inertia(mass: float, offset: np.ndarray) -> np.ndarray:
    """Inertia ``[3, 3]`` of a point mass at an offset ``[3]``: ``m (|r|^2 1 - r r^T)``."""
    return mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))


def combined_mass(parts: Sequence[tuple[Mass, Frame]]) -> Mass:
    """Mass of parts together, whose centers of mass are in their frames."""
    placed = [(each, frame @ Frame(np.array(each.center), np.eye(3))) for each, frame in parts if each.mass > 0]
    if not placed:
        return WEIGHTLESS
    if len(placed) == 1 and not placed[0][1].is_turned:
        return placed[0][0]._replace(center=tuple(placed[0][1].position.tolist()))
    masses = np.array([each.mass for each, _ in placed])
    mass = float(masses.sum())
    center = masses @ np.stack([pose.position for _, pose in placed]) / mass
    inertia = np.zeros((3, 3))
    for each, pose in placed:
        inertia += pose.rotation @ np.array(each.inertia) @ pose.rotation.T
        inertia += point_inertia(each.mass, pose.position - center)
    return Mass.of(mass, center, inertia)


def box_mass(mass: float, center: np.ndarray, size: np.ndarray) -> Mass:
    """Mass of a box of even density."""
    squares = np.asarray(size) ** 2
    return Mass.of(mass, np.asarray(center), np.diag(mass / 12 * (squares.sum() - squares)))


def nine_digits(numbers: Any) -> Any:
    """Nested tuples with their numbers rounded to nine digits."""
    if isinstance(numbers, tuple):
        rounded = [nine_digits(each) for each in numbers]
        return type(numbers)(*rounded) if hasattr(numbers, "_fields") else tuple(rounded)
    # Adding 0 turns -0.0 into 0.0.
    return float(f"{numbers + 0.0:.9g}") if isinstance(numbers, float) else numbers
