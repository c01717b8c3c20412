"""Places of the sensors on a robot, and what of its surface can be drawn."""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np
import trimesh

from rover_rl.robots.description import Frame, Shape
from rover_rl.robots.meshes import find_mesh
from rover_rl.robots.urdf.body import Box
from rover_rl.robots.urdf.placed import Placed

_LIDARS = re.compile(r"lidar|laser|scan|hokuyo|velodyne|sick|ouster|(^|_)urg|(^|_)lds|livox")
_HOLDERS = re.compile(r"mount|bracket|plate|support|holder|standoff|adapter|riser|optical")
ABOVE = 0.05
"""Height above the body of a lidar whose place is not stated, m."""


def sensor_mounts(
    placed: Placed, boxes: list[Box], origin: np.ndarray, lidar: str | None, notes: list[str]
) -> dict[str, tuple[float, float, float]]:
    """Returns the places of the lidar and the IMU in the base frame, by the names of their links.

    Args:
        placed: the URDF.
        boxes: boxes of the body, in the base frame.
        origin: origin of the base frame, ``[3]``, m.
        lidar: link of the lidar, or its place "x y z" in the base frame. ``None``: by the names of the links.
        notes: gets a sentence on what is assumed.

    Raises:
        ValueError: if the link does not exist, or the place is not three numbers.
    """
    low, high = (np.array([box[end] for box in boxes]) for end in (0, 1))
    middle = (low.min(0) + high.max(0)) / 2
    imus = [name for name in placed.frames if "imu" in name.lower()]
    imu = placed.frames[imus[0]].position - origin if imus else middle
    return {
        "lidar_link": _lidar(placed, origin, lidar, (*middle[:2], high[:, 2].max() + ABOVE), notes),
        "imu_link": _place(imu),
    }


def _lidar(
    placed: Placed, origin: np.ndarray, given: str | None, top: Iterable[float], notes: list[str]
) -> tuple[float, float, float]:
    if given is not None and given not in placed.frames:
        try:
            x, y, z = map(float, given.split())
        except ValueError:
            raise ValueError(
                f'lidar must be "x y z" in meters, or one of its links {sorted(placed.frames)}, got {given!r}'
            ) from None
        return x, y, z
    name = given or _lidar_link(placed)
    if name is None:
        place = _place(top)
        notes.append(f"it names no lidar: one at {_text(place)} m, above its middle, is assumed")
        return place
    if given is None:
        notes.append(f"link {name!r} is taken for its lidar")
    return _place(placed.frames[name].position - origin)


def _lidar_link(placed: Placed) -> str | None:
    """Returns the link with the name of a lidar: of several, the one farthest ahead."""
    named = [name for name in placed.frames if _LIDARS.search(name.lower())]
    named = [name for name in named if not _HOLDERS.search(name.lower())] or named
    # Of the links of one lidar, the last holds the frame of its readings.
    ends = [name for name in named if not any(other in named for other in [*placed.below(name)][1:])]
    return max(ends, key=lambda name: round(placed.frames[name].position[0], 3), default=None)


def visible_shapes(placed: Placed, origin: np.ndarray) -> list[tuple[Frame, Shape]]:
    """Returns the visual shapes that can be drawn, with their poses in the base frame. Meshes have absolute paths."""
    shapes = []
    for name, frame in placed.frames.items():
        for shape in placed.description.links[name].visuals:
            pose = frame @ shape.frame
            if shape.kind == "mesh":
                try:
                    path = find_mesh(shape.file, placed.path)
                except ValueError:
                    continue
                if path.suffix.lower().lstrip(".") not in trimesh.available_formats():
                    continue
                shape = shape._replace(file=str(path))
            elif shape.kind not in ("box", "cylinder", "sphere"):
                continue
            shapes.append((Frame(pose.position - origin, pose.rotation), shape))
    return shapes


def _place(position: Iterable[float]) -> tuple[float, float, float]:
    x, y, z = (round(float(each), 9) for each in position)
    return x, y, z


def _text(place: Iterable[float]) -> str:
    return " ".join(f"{each:.3g}" for each in place)
