"""From a raw scan to what the policy sees: cleaned, and pooled to the nearest reading of each segment."""

from __future__ import annotations

import torch
from torch import Tensor


class LidarPooling:
    """Cleans raw scans and keeps the minimum of each of ``points`` segments.

    Segments are runs of neighbouring beams, the first beginning straight ahead, as equal in size as can be: no beam is
    dropped. ``+inf`` and NaN become ``max_range``, ``-inf`` means "too close" (REP 117) and becomes 0, and all is
    clipped to ``[0, max_range]``.

    Args:
        beams: beams of a raw scan.
        points: segments (the contract's ``lidar_points``).
        max_range: the contract's ``max_lidar_range``, m.
        device: where scans are.

    Raises:
        ValueError: for fewer beams than points, no points, or a range that is not positive.

    Example:
        >>> pool = LidarPooling(beams=4, points=2, max_range=12.0)
        >>> pool(torch.tensor([[3.0, float("inf"), 1.0, 2.0]]))
        tensor([[3., 1.]])
    """

    def __init__(self, beams: int, points: int, max_range: float, device: torch.device | str | None = None) -> None:
        if points < 1:
            raise ValueError(f"lidar_points must be at least 1, got {points}")
        if beams < points:
            raise ValueError(f"lidar_beams must be at least lidar_points, got {beams} beams for {points} points")
        if not 0 < max_range < float("inf"):
            raise ValueError(f"max_lidar_range must be a positive number of metres, got {max_range}")
        self.beams = beams
        self.points = points
        self.max_range = float(max_range)
        self._gather = None if beams % points == 0 else _segments(beams, points).to(device)

    def __call__(self, ranges: Tensor) -> Tensor:
        """Pools ``ranges [N, beams]`` (m) to ``[N, points]``."""
        # NaN would win every minimum, so it goes first; clipping can wait for the fewer pooled values.
        ranges = torch.nan_to_num(ranges, nan=self.max_range, posinf=self.max_range, neginf=0.0)
        grouped = ranges.unflatten(-1, (self.points, -1)) if self._gather is None else ranges[..., self._gather]
        return grouped.amin(-1).clamp(0.0, self.max_range)


def _segments(beams: int, points: int) -> Tensor:
    """Beam numbers of each segment, ``[points, longest]``; short segments repeat their last beam."""
    parts = torch.arange(beams).tensor_split(points)
    longest = max(len(part) for part in parts)
    return torch.stack([torch.cat((part, part[-1:].expand(longest - len(part)))) for part in parts])
