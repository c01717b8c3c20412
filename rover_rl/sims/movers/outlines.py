"""Outlines of the parts of movers, seen from above."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from torch import Tensor

from rover_rl.sims.worlds.movers.shapes import KINDS, Part


def outlines(kind: Tensor, half: Tensor, position: Tensor, orientation: Tensor) -> list[np.ndarray]:
    """Returns the outline of each part from above, ``[corners, 2]``, m.

    Args:
        kind: index in :data:`~rover_rl.sims.worlds.movers.shapes.KINDS`, ``[P]``.
        half: half of the length, width and height, ``[P, 3]``, m.
        position: center, ``[P, 3]``, m.
        orientation: unit quaternion (x, y, z, w), ``[P, 4]``.
    """
    found = []
    for number, size, center, turn in zip(kind.tolist(), (2 * half).tolist(), position, orientation, strict=True):
        corners = Rotation.from_quat(turn.numpy()).apply(Part(KINDS[number], tuple(size), (0.0, 0.0, 0.0)).corners())
        seen = corners[:, :2] + center[:2].numpy()
        found.append(seen[ConvexHull(seen).vertices])
    return found
