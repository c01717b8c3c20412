"""Field of view: the directions that the lidar of a robot sees."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rover_rl.sims.base import Scanner

_TOLERANCE = 1e-6
"""Tolerance of angles at the borders of a view, rad."""


def seen(angles: Tensor, view: float) -> Tensor:
    """Returns whether directions are in a view that is centered on straight ahead, bool of the shape of ``angles``.

    Args:
        angles: directions, counter-clockwise from straight ahead, rad.
        view: total angle of the view, rad.
    """
    return (torch.remainder(angles + math.pi, 2 * math.pi) - math.pi).abs() <= view / 2 + _TOLERANCE


class ViewScanner:
    """Lidar that sees less than a full turn: beams outside of its view have no return.

    Args:
        scanner: lidar with a full turn of beams: see :class:`~rover_rl.sims.base.Scanner`.
        view: total angle of the view, rad.
    """

    def __init__(self, scanner: Scanner, view: float) -> None:
        self.angles = scanner.angles
        self._scanner, self._hidden = scanner, ~seen(scanner.angles, view)

    def scan(self, rows: Tensor | None = None) -> Tensor:
        """Scans: see :meth:`~rover_rl.sims.base.Scanner.scan`."""
        return self._scanner.scan(rows).masked_fill(self._hidden, math.inf)


def in_view(scanner: Scanner, view: float) -> Scanner:
    """Returns a lidar with a view (rad), which is the scanner itself for a full turn."""
    return scanner if view >= 2 * math.pi - _TOLERANCE else ViewScanner(scanner, view)
