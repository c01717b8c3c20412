"""Movers, and their shapes: upright convex solids, one or several a mover."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Literal, Protocol, TypeAlias, get_args

import numpy as np

from rover_rl.checks import check_positive
from rover_rl.worlds.movers.motion import Motion

Kind: TypeAlias = Literal["cylinder", "box", "capsule"]
KINDS: tuple[Kind, ...] = get_args(Kind)
MAX_MOVERS = 512
"""Maximum number of movers in a world."""
MAX_SIDE = 1000.0
"""Longest side of a shape, m."""
_SIDES = 24
"""Number of sides of the prism that stands for a cylinder in contacts."""


@dataclass(frozen=True)
class Part:
    """A convex solid of a mover, whose axis is its own z axis.

    Args:
        kind: ``"cylinder"``, ``"box"`` or ``"capsule"`` (a cylinder with hemispherical ends).
        size: length along x, width along y and height along z, m. A cylinder and a capsule have their diameter as
            length and width, and the height of a capsule includes its ends.
        center: center in the frame of the mover, whose origin is on the ground and whose x axis points ahead, m.
        orientation: orientation in this frame, unit quaternion (x, y, z, w).
        swing: amplitude with which the part swings along x while the mover walks, m. A negative one is half a cycle
            apart.
    """

    kind: Kind
    size: tuple[float, float, float]
    center: tuple[float, float, float]
    orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    swing: float = 0.0

    @property
    def reach(self) -> float:
        """Radius of a vertical cylinder around the origin of the mover that contains the part, m."""
        x, y, _ = self.center
        length, width, height = self.size
        upright = self.orientation[:2] == (0.0, 0.0)
        half = length / 2 if self.kind != "box" and upright else math.hypot(length, width, 0 if upright else height) / 2
        return math.hypot(x, y) + abs(self.swing) + half

    def corners(self) -> np.ndarray:
        """Vertices of a convex polyhedron that stands for the part in contacts, in its own frame, ``[V, 3]``, m."""
        length, _, height = self.size
        if self.kind == "box":
            signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
            return signs * np.array(self.size) / 2
        turns = 2 * math.pi * (np.arange(_SIDES) + 0.5) / _SIDES
        # A prism with the volume of the cylinder.
        radius = length / 2 * math.sqrt(2 * math.pi / (_SIDES * math.sin(2 * math.pi / _SIDES)))
        cos, sin = np.cos(turns), np.sin(turns)
        # Rings (share of the radius, height) from the bottom to the top.
        rings = [(1.0, -height / 2), (1.0, height / 2)]
        if self.kind == "capsule":
            angles = (0.0, *np.radians((20.0, 55.0, 85.0)))
            cap = [(math.cos(angle), height / 2 - length / 2 * (1 - math.sin(angle))) for angle in angles]
            rings = [(r, -z) for r, z in reversed(cap)] + cap
        return np.concatenate([np.stack((r * radius * cos, r * radius * sin, np.full(_SIDES, z)), 1) for r, z in rings])


class Shape(Protocol):
    """Interface of the shape of a mover."""

    def parts(self) -> tuple[Part, ...]: ...


@dataclass(frozen=True)
class _Upright:
    """Base of shapes whose fields are lengths."""

    def __post_init__(self) -> None:
        check_positive(MAX_SIDE, **asdict(self))


def _on_ground(kind: Kind, length: float, width: float, height: float) -> tuple[Part, ...]:
    return (Part(kind, (length, width, height), (0.0, 0.0, height / 2)),)


@dataclass(frozen=True)
class Cylinder(_Upright):
    """Upright cylinder on the ground. Lengths in m."""

    radius: float = 0.3
    height: float = 1.5

    def parts(self) -> tuple[Part, ...]:
        return _on_ground("cylinder", 2 * self.radius, 2 * self.radius, self.height)


@dataclass(frozen=True)
class Box(_Upright):
    """Upright box on the ground, whose length is along the heading. Lengths in m."""

    length: float = 1.0
    width: float = 1.0
    height: float = 1.0

    def parts(self) -> tuple[Part, ...]:
        return _on_ground("box", self.length, self.width, self.height)


@dataclass(frozen=True)
class Capsule(_Upright):
    """Upright cylinder with hemispherical ends, which stands on the ground. The height includes the ends. In m."""

    radius: float = 0.3
    height: float = 1.7

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.height < 2 * self.radius:
            raise ValueError(f"height must be at least the diameter {2 * self.radius:g}, got {self.height}")

    def parts(self) -> tuple[Part, ...]:
        return _on_ground("capsule", 2 * self.radius, 2 * self.radius, self.height)


@dataclass(frozen=True)
class Person(_Upright):
    """A person as a lidar sees one: two legs that swing while walking, below a body.

    Args:
        height: height of the person, m. The other lengths scale with it.

    The legs are cylinders with a radius of 7 cm at 0.12 m to each side, as the shanks in scans of people are (K. O.
    Arras et al., "Using boosted features for the detection of people in 2D range data", ICRA 2007, where legs are 10 to
    25 cm wide).
    """

    height: float = 1.75

    def parts(self) -> tuple[Part, ...]:
        scale = self.height / 1.75
        hip, side, swing = 0.85 * scale, 0.12 * scale, 0.22 * scale
        leg = (0.14 * scale, 0.14 * scale, hip)
        left, right = (Part("cylinder", leg, (0.0, sign * side, hip / 2), swing=sign * swing) for sign in (1, -1))
        trunk = self.height - hip
        return left, right, Part("cylinder", (0.44 * scale, 0.44 * scale, trunk), (0.0, 0.0, hip + trunk / 2))


@dataclass(frozen=True)
class Mover:
    """An obstacle or a person that moves on the ground of a world.

    Args:
        motion: how it moves.
        shape: its shape.
        name: name for messages.

    Raises:
        ValueError: if the motion is none, or the shape has no parts.

    Example:
        >>> from rover_rl.worlds.movers import Mover, Person, Waypoints
        >>> walker = Mover(
        ...     Waypoints([(0.0, 2.0, -3.0, 1.57), (6.0, 2.0, 3.0, 1.57)], repeat="back_and_forth"), Person()
        ... )
        >>> world = World("crossing", Terrain.flat((20.0, 20.0)), movers=[walker])
    """

    motion: Motion
    shape: Shape = field(default_factory=Cylinder)
    name: str = "mover"

    def __post_init__(self) -> None:
        if not isinstance(self.motion, Motion):
            raise ValueError(f"the motion of {self.name!r} must be a Motion, as Waypoints(...), got {self.motion!r}")
        if not hasattr(self.shape, "parts") or not self.shape.parts():
            raise ValueError(f"the shape of {self.name!r} must have parts, as Cylinder(0.3) has, got {self.shape!r}")

    @property
    def radius(self) -> float:
        """Radius of an upright cylinder around the mover that contains its shape, m."""
        return max(part.reach for part in self.shape.parts())
