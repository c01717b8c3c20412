"""Field of view: the directions that the lidar of a robot sees."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rover_rl.robots.fleet import Fleet
from rover_rl.sims.base import Scanner

_TOLERANCE = 1e-6
"""Tolerance of angles at the borders of a view, rad."""


def seen(angles: Tensor, view: float | Tensor) -> Tensor:
    """Returns whether directions are in a view that is centered on straight ahead, bool of the shape of ``angles``.

    Args:
        angles: directions, counter-clockwise from straight ahead, rad.
        view: total angle of the view, or of several views, with which ``angles`` are broadcast, rad.
    """
    return (torch.remainder(angles + math.pi, 2 * math.pi) - math.pi).abs() <= view / 2 + _TOLERANCE


class ViewScanner:
    """Lidar that sees less than a full turn: beams outside of its view have no return.

    Args:
        scanner: lidar with a full turn of beams: see :class:`~rover_rl.sims.base.Scanner`.
        fleet: robots of the rows, whose lidars have views.
    """

    def __init__(self, scanner: Scanner, fleet: Fleet) -> None:
        self.angles = scanner.angles
        self._scanner, self._fleet = scanner, fleet
        # Beams outside of the view of each robot's lidar, [K, beams].
        self._hidden = torch.stack([~seen(scanner.angles, robot.lidar_view) for robot in fleet.robots])

    def scan(self, rows: Tensor | None = None) -> Tensor:
        """Scans: see :meth:`~rover_rl.sims.base.Scanner.scan`."""
        hidden = self._hidden
        if len(hidden) > 1:
            hidden = hidden[self._fleet.index.to(hidden.device)]
        return self._scanner.scan(rows).masked_fill(hidden, math.inf)


def in_view(scanner: Scanner, fleet: Fleet) -> Scanner:
    """Returns a lidar with the views of the robots, which is the scanner itself if they see a full turn."""
    least = min(robot.lidar_view for robot in fleet.robots)
    return scanner if least >= 2 * math.pi - _TOLERANCE else ViewScanner(scanner, fleet)
