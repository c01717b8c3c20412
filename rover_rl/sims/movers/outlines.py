"""Corners of the parts of movers, and their outlines, seen from above."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from torch import Tensor

from rover_rl.worlds.movers.shapes import KINDS, Part


def outlines(kind: Tensor, half: Tensor, position: Tensor, orientation: Tensor) -> list[np.ndarray]:
    """Returns the outline of each part from above, ``[corners, 2]``, m. The arguments are those of :func:`corners`."""
    seen = (points[:, :2] for points in corners(kind, half, position, orientation))
    return [points[ConvexHull(points).vertices] for points in seen]


def corners(kind: Tensor, half: Tensor, position: Tensor, orientation: Tensor) -> list[np.ndarray]:
    """Returns the corners of each part, ``[corners, 3]``, m.

    Args:
        kind: index in :data:`~rover_rl.worlds.movers.shapes.KINDS`, ``[P]``.
        half: half of the length, width and height, ``[P, 3]``, m.
        position: center, ``[P, 3]``, m.
        orientation: unit quaternion (x, y, z, w), ``[P, 4]``.
    """
    return [
        Rotation.from_quat(turn.numpy()).apply(Part(KINDS[number], tuple(size), (0.0, 0.0, 0.0)).corners())
        + center.numpy()
        for number, size, center, turn in zip(kind.tolist(), (2 * half).tolist(), position, orientation, strict=True)
    ]
