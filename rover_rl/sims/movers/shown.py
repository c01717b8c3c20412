"""Movers of one row, for pictures and records."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from torch import Tensor

from rover_rl.sims.movers.field import MoverField
from rover_rl.sims.movers.parts import Parts

CLOSE = 1.0
"""Distance from a camera up to which a mover is left out, m: it would hide the rover, 2.55 m away, and all else."""


def parts_of(movers: MoverField | None, row: int) -> Parts | None:
    """Returns a copy of the parts that a row has, on the CPU and with one row. ``None`` if it has none."""
    return None if movers is None or movers.parts is None else parts_in(movers.parts, row)


def parts_in(parts: Parts, row: int) -> Parts | None:
    """Returns a copy of those of ``parts`` that a row has, on the CPU and with one row. ``None`` if it has none."""
    shown = (parts.kind[row] >= 0).nonzero().squeeze(-1)
    return chosen(parts, row, shown) if len(shown) else None


def chosen(parts: Parts, row: int, indices: Tensor) -> Parts:
    """Returns a copy of some parts of a row, on the CPU and with one row."""
    return Parts(**{item.name: getattr(parts, item.name)[row : row + 1, indices].cpu() for item in fields(Parts)})


def in_view(parts: Parts, eye: np.ndarray) -> np.ndarray:
    """Returns the indices of the parts of one row whose movers are not too close to a camera at ``eye [3]`` (m)."""
    position, half, mover = parts.position[0].numpy(), parts.half[0].numpy(), parts.mover[0].numpy()
    gap = np.linalg.norm(position - eye, axis=1) - np.linalg.norm(half, axis=1)
    return np.flatnonzero(~np.isin(mover, mover[gap < CLOSE]))
