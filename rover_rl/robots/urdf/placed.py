"""Links of a URDF in a common frame, with all joints held, and the points of their shapes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rover_rl.robots.description import Description, Frame, Joint, Shape
from rover_rl.robots.meshes import find_mesh, load_mesh

_ROUND = 32
"""Number of points on a circle. A multiple of 4, so that the bounds along the axes are exact."""


class Piece(NamedTuple):
    """A shape: its kind, its sizes, its pose, and the points ``[P, 3]`` that it is the hull of, m."""

    link: str
    kind: str
    sizes: tuple[float, ...]
    frame: Frame
    points: np.ndarray


class Placed:
    """Links of a URDF with each joint at zero, or at the limit that is nearest to zero.

    Args:
        path: path of the URDF.
        turn: rotation of all links about +z, rad.

    Attributes:
        description: contents of the file.
        frames: poses of the links, by name.
        mounts: joint that holds each link, by the name of the link; the base has none.
        lost: what was left out of the file and of its meshes, a sentence each.
    """

    def __init__(self, path: Path, turn: float = 0.0) -> None:
        self.path = path
        self.description = Description(path, lenient=True)
        self.lost = [*self.description.left_out]
        root = Frame(np.zeros(3), Rotation.from_rotvec((0, 0, turn)).as_matrix())
        self.frames = {self.description.base: root}
        self.mounts = {joint.child: joint for joint in self.description.joints.values()}
        self._below: dict[str, list[str]] = {name: [] for name in self.description.links}
        for joint in self.description.joints.values():
            self._below[joint.parent].append(joint.child)
        for name in self.below(self.description.base):
            if name in self.mounts:
                joint = self.mounts[name]
                self.frames[name] = self.frames[joint.parent] @ joint.frame @ _held(joint)

    def below(self, link: str) -> Iterator[str]:
        """Names a link and all that hangs on it, each after what it hangs on."""
        yield link
        for each in self._below[link]:
            yield from self.below(each)

    def chain(self, link: str) -> list[Joint]:
        """Returns the joints between the base and a link, the base's first."""
        if link not in self.mounts:
            return []
        joint = self.mounts[link]
        return [*self.chain(joint.parent), joint]

    def axis(self, joint: Joint) -> np.ndarray:
        """Returns the direction of the axis of a joint, ``[3]``; zeros if the file states none."""
        length = float(np.linalg.norm(joint.axis))
        return self.frames[joint.child].rotation @ joint.axis / length if length > 0 else np.zeros(3)

    def pieces(self, links: Iterable[str], visual: bool, problems: list[str]) -> list[Piece]:
        """Returns the collision or visual shapes of links. Adds what cannot be read to ``problems``."""
        found = []
        for name in links:
            link = self.description.links[name]
            for shape in link.visuals if visual else link.shapes:
                frame = self.frames[name] @ shape.frame
                try:
                    points, lost = _points(shape, self.path)
                except ValueError as error:
                    problems.append(str(error))
                    continue
                self.lost += [sentence for sentence in lost if sentence not in self.lost]
                found.append(Piece(name, shape.kind, shape.sizes, frame, frame.position + points @ frame.rotation.T))
        return found


def _held(joint: Joint) -> Frame:
    """Returns the motion of a joint that is held at the position nearest to zero."""
    low, high = joint.limits or (0.0, 0.0)
    if joint.kind not in ("revolute", "prismatic") or not low <= high:
        return Frame(np.zeros(3), np.eye(3))
    step = min(max(0.0, low), high) * joint.axis / max(float(np.linalg.norm(joint.axis)), 1e-12)
    if joint.kind == "prismatic":
        return Frame(step, np.eye(3))
    return Frame(np.zeros(3), Rotation.from_rotvec(step).as_matrix())


def _points(shape: Shape, urdf: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """Returns points in the frame of a shape, whose hull is that of the shape, and what its mesh file lacks."""
    if shape.kind == "box":
        corners = np.stack(np.meshgrid((-0.5, 0.5), (-0.5, 0.5), (-0.5, 0.5)), -1).reshape(-1, 3)
        return corners * shape.sizes, ()
    if shape.kind == "mesh":
        path = find_mesh(shape.file, urdf)
        return _mesh_points(path, shape.sizes, path.stat().st_mtime_ns)
    angles = np.arange(_ROUND) * 2 * math.pi / _ROUND
    circle = np.column_stack((np.cos(angles), np.sin(angles), np.zeros(_ROUND)))
    if shape.kind == "cylinder":
        radius, length = shape.sizes
        return np.concatenate([radius * circle + (0, 0, side * length / 2) for side in (-1, 1)]), ()
    if shape.kind == "sphere":
        return shape.sizes[0] * np.concatenate([np.roll(circle, turn, 1) for turn in range(3)]), ()
    raise ValueError(f"a shape is a {shape.kind}; use a box, cylinder, sphere or mesh")


@lru_cache(maxsize=256)
def _mesh_points(path: Path, scale: tuple[float, ...], modified: int) -> tuple[np.ndarray, tuple[str, ...]]:
    """Returns the vertices of a mesh file, and what it lacks. ``modified`` is the time of its last change."""
    lost: list[str] = []
    return np.concatenate([np.asarray(mesh.vertices) for mesh in load_mesh(path, scale, lost)]), tuple(lost)
