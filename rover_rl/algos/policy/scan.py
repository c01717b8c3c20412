"""Where a lidar scan hits."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def hit_points(lidar: Tensor, lidar_offset: Tensor | float, middle: float = 0.5) -> tuple[Tensor, Tensor]:
    """Returns x and y of the points that readings of a lidar hit, in the base frame, ``[..., points]`` each, m.

    A reading is taken to come from ``middle`` in its segment, a share of the segment.
    """
    points = lidar.shape[-1]
    angles = (torch.arange(points, dtype=lidar.dtype, device=lidar.device) + middle) * (2 * math.pi / points)
    return lidar * angles.cos() + lidar_offset, lidar * angles.sin()
