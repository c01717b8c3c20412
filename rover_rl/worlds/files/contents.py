"""What the readers find in a file, before it becomes a world."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np

from rover_rl.worlds.files.options import MAX_SIZE
from rover_rl.worlds.movers import Mover


@dataclass(frozen=True)
class Piece:
    """A solid or a surface, by its name in the file.

    ``points [V, 3]`` are vertices in its own frame, which copies of a mesh share, and ``vertices`` those in the world
    frame, m; ``pose [4, 4]`` is the affine transform between them. ``faces [F, 3]`` are triangles, counter-clockwise
    from outside; ``None``: the piece is the convex hull of the points.
    """

    name: str
    points: np.ndarray
    faces: np.ndarray | None = None
    pose: np.ndarray = field(default_factory=partial(np.eye, 4))
    vertices: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", self.points @ self.pose[:3, :3].T + self.pose[:3, 3])
        if not np.isfinite(self.vertices).all():
            raise ValueError(f"{self.name} has a vertex that is NaN or infinite")
        reach = np.abs(self.vertices).max(initial=0.0)
        if reach > MAX_SIZE:
            raise ValueError(
                f"{self.name} reaches {reach:.3g} m from the origin; at most {MAX_SIZE:g} m are supported, so check "
                "the unit and the scale"
            )


class Plane(NamedTuple):
    """An infinite plane of ground: a point (m), the upward unit normal, and the side lengths in the file (m)."""

    point: np.ndarray
    normal: np.ndarray = np.array((0.0, 0.0, 1.0))
    size: tuple[float, float] = (0.0, 0.0)


class Grid(NamedTuple):
    """Elevations on a regular grid, turned by ``yaw`` (rad) about ``origin``, the position of ``heights[0, 0]``, m.

    ``heights`` are ``[rows, columns]``, m, with rows along +y; NaN: no ground. ``cell`` is the spacing along x and y,
    m.
    """

    heights: np.ndarray
    cell: tuple[float, float]
    origin: tuple[float, float]
    yaw: float = 0.0


@dataclass
class Contents:
    """Everything that a reader found in a file.

    ``left_out`` says what was left out and why, as warnings do, and ``notes`` what else a user may want to know, one
    sentence each. ``wrong`` has the errors of the parts that cannot be read, and are left out as well.
    """

    name: str
    pieces: list[Piece] = field(default_factory=list)
    planes: list[Plane] = field(default_factory=list)
    grids: list[Grid] = field(default_factory=list)
    movers: list[Mover] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    wrong: list[ValueError] = field(default_factory=list)

    @contextmanager
    def leaving_out(self, name: str = "") -> Iterator[None]:
        """Leaves out the part that is read in this context if it is wrong."""
        try:
            yield
        except ValueError as error:
            self.wrong.append(error if name in str(error) else ValueError(f"{name}: {error}"))


def listed(names: Iterable[str], most: int = 8) -> str:
    """Returns names as text, shortened after ``most``."""
    names = list(dict.fromkeys(names))
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
