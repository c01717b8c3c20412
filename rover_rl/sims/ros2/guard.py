"""Guard of the command path: a live rover does not move towards what no lidar beam covers."""

from __future__ import annotations

import math

import torch
from torch import Tensor

SECTOR = math.radians(45)
"""Half of the angle around the direction of travel that must be seen, rad.

A rover with a footprint radius of 0.35 m that stops within 0.35 m sweeps nothing outside of it that it has not seen
before from farther away."""


class UnseenGuard:
    """Cancels the forward speed of commands that lead towards unseen directions.

    Turning on the spot stays allowed: it is how a rover looks elsewhere.

    Args:
        angles: direction of each beam, ``[beams]``, rad from straight ahead.
    """

    def __init__(self, angles: Tensor) -> None:
        ahead = angles.cos() >= math.cos(SECTOR) - 1e-6
        behind = angles.cos() <= -math.cos(SECTOR) + 1e-6
        self._sectors = torch.stack((ahead, behind))

    def blocked(self, speed: float, seen: Tensor) -> bool:
        """Whether a forward speed (m/s) leads towards a direction that is not ``seen`` (bool ``[beams]``)."""
        if speed == 0.0:
            return False
        return bool((self._sectors[0 if speed > 0 else 1] & ~seen).any())
