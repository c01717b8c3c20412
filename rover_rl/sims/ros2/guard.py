"""Guard that blocks motion towards directions that no lidar beam covers."""

from __future__ import annotations

import math

import torch
from torch import Tensor

SECTOR = math.radians(45)
"""Half-angle of the sector around the direction of travel in which every beam must be seen, rad.

A rover with a footprint radius of 0.35 m and a stopping distance of 0.35 m sweeps no area outside of this sector that
it has not already seen from farther away."""


class UnseenGuard:
    """Blocks forward speeds towards unseen directions.

    Turning on the spot stays allowed, so that a rover can look in other directions.

    Args:
        angles: direction of each beam, counter-clockwise from straight ahead, ``[beams]``, rad.
    """

    def __init__(self, angles: Tensor) -> None:
        ahead = angles.cos() >= math.cos(SECTOR) - 1e-6
        behind = angles.cos() <= -math.cos(SECTOR) + 1e-6
        self._sectors = torch.stack((ahead, behind))

    def blocks(self, speed: float, seen: Tensor) -> bool:
        """Whether a forward speed leads towards an unseen direction.

        Args:
            speed: forward speed, m/s; negative speeds lead backward.
            seen: whether each beam is seen, bool ``[beams]``.
        """
        if speed == 0.0:
            return False
        return bool((self._sectors[0 if speed > 0 else 1] & ~seen).any())
