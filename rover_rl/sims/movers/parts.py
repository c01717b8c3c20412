"""``Parts``: solids of the movers of each row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

MAX_SPEED = 20.0
"""Speed above which a solid is put from one place to another, and pushes nothing in between, m/s."""


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
        """Creates parts of the given numbers of rows and parts at the origin."""
        zeros = torch.zeros(*shape, device=device)
        points = torch.zeros(*shape, 3, device=device)
        return cls(
            kind=zeros.int() - 1,
            form=zeros.int() - 1,
            half=points.clone(),
            mover=zeros.long(),
            position=points.clone(),
            orientation=torch.zeros(*shape, 4, device=device),
            velocity=points,
            turn=zeros,
        )

    def columns(self, first: int, end: int) -> Parts:
        """Returns some parts of each row, in the same memory."""
        return Parts(**{item.name: getattr(self, item.name)[:, first:end] for item in fields(self)})
