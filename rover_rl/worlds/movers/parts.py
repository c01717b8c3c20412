"""``Parts``: solids of the movers of each row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from torch import Tensor

from rover_rl.worlds.movers.mover import KINDS, Part

MAX_SPEED = 20.0
"""Speed above which a solid is put from one place to another, and pushes nothing in between, m/s."""
CLOSE = 1.0
"""Distance from a camera up to which a mover is left out, m: it would hide the rover, 2.55 m away, and all else."""


@dataclass
class Parts:
    """Convex solids of the movers of each row, for sensors and physics. Rows with fewer than ``P`` are filled up.

    Attributes:
        kind: 0 for a cylinder, 1 for a box, 2 for a capsule, -1 for none, int32 ``[N, P]``.
        form: index in :attr:`MoverField.forms`, -1 for none, int32 ``[N, P]``.
        half: half of the length, width and height, ``[N, P, 3]``, m.
        mover: index of the part's mover, int64 ``[N, P]``. The other rovers of a group come after all movers.
        position: center now, that is at the end of the last step, ``[N, P, 3]``, m.
        orientation: orientation now, unit quaternion (x, y, z, w), ``[N, P, 4]``.
        velocity: velocity during the last step, ``[N, P, 3]``, m/s. 0 if no time has passed.
        turn: yaw rate during the last step, ``[N, P]``, rad/s.
    """

    kind: Tensor
    form: Tensor
    half: Tensor
    mover: Tensor
    position: Tensor
    orientation: Tensor
    velocity: Tensor
    turn: Tensor

    @classmethod
    def zeros(cls, shape: Sequence[int], device: torch.device) -> Parts:
        """Creates parts of no kind at the origin, in ``shape`` ``[N, P]``."""
        none = torch.full((*shape,), -1, dtype=torch.int32, device=device)
        half, position, velocity = torch.zeros(3, *shape, 3, device=device)
        turns, zeros = torch.zeros(*shape, 4, device=device), torch.zeros(*shape, device=device)
        return cls(none, none.clone(), half, zeros.long(), position, turns, velocity, zeros)

    def columns(self, first: int, end: int) -> Parts:
        """Returns some parts of each row, in the same memory."""
        return Parts(**{item.name: getattr(self, item.name)[:, first:end] for item in fields(self)})

    def chosen(self, row: int, indices: Tensor) -> Parts:
        """Returns a copy of some parts of a row, on the CPU and with one row."""
        return Parts(**{item.name: getattr(self, item.name)[row : row + 1, indices].cpu() for item in fields(self)})

    def of_row(self, row: int) -> Parts | None:
        """Returns a copy of the parts that a row has, on the CPU and with one row. ``None`` if it has none."""
        shown = (self.kind[row] >= 0).nonzero()[:, 0]
        return self.chosen(row, shown) if len(shown) else None

    def in_view(self, eye: np.ndarray) -> np.ndarray:
        """Returns the indices of the parts of the first row whose movers are not too close to a camera at ``eye``."""
        position, half, mover = self.position[0].numpy(), self.half[0].numpy(), self.mover[0].numpy()
        gap = np.linalg.norm(position - eye, axis=1) - np.linalg.norm(half, axis=1)
        return np.flatnonzero(~np.isin(mover, mover[gap < CLOSE]))


def corners(kind: Tensor, half: Tensor, position: Tensor, orientation: Tensor) -> list[np.ndarray]:
    """Returns the corners of parts ``[P, ...]``, as in one row of :class:`Parts`, ``[corners, 3]`` of each, m."""
    parts = [Part(KINDS[number], size, (0.0, 0.0, 0.0)) for number, size in zip(kind, (2 * half).tolist(), strict=True)]
    places = zip(parts, position.numpy(), orientation.numpy(), strict=True)
    return [Rotation.from_quat(turn).apply(part.corners()) + center for part, center, turn in places]


def outlines(kind: Tensor, half: Tensor, position: Tensor, orientation: Tensor) -> list[np.ndarray]:
    """Returns the outline of each part from above, ``[corners, 2]``, m. The arguments are those of :func:`corners`."""
    seen = (points[:, :2] for points in corners(kind, half, position, orientation))
    return [points[ConvexHull(points).vertices] for points in seen]
