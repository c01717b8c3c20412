"""Where a lidar scan hits."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rover_rl.envs.sensors.scan_pose import seen_from_now


def hit_points(
    lidar: Tensor, lidar_offset: Tensor | float, middle: float = 0.5, scan_pose: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Returns x and y of the points that readings of a lidar hit, in the base frame, ``[..., points]`` each, m.

    Args:
        lidar: lidar readings, ``[..., points]``, m.
        lidar_offset: distance of the lidar in front of the base, m.
        middle: where in its segment a reading is taken to come from, a share of the segment.
        scan_pose: where the scan was taken, ``[..., 6]``: see :class:`~rover_rl.envs.sensors.scan_pose.ScanPose`.
            ``None``: where the rover is.
    """
    points = lidar.shape[-1]
    angles = (torch.arange(points, dtype=lidar.dtype, device=lidar.device) + middle) * (2 * math.pi / points)
    x, y = lidar * angles.cos() + lidar_offset, lidar * angles.sin()
    return (x, y) if scan_pose is None else seen_from_now(x, y, scan_pose)
