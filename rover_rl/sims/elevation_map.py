"""Elevation map: heights of the ground on a grid, as far as they are known."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import torch
from torch import Tensor


class ElevationMap(NamedTuple):
    """Heights of the ground on a grid along the axes of a frame, in the order of ANYbotics' grid_map.

    Attributes:
        heights: heights ``[rows, columns]``, m; NaN where none is known. The first row has the largest x, and the first
            column the largest y.
        center: x and y of the middle of the map, m.
        cell: side of a cell, m.
        layer: name of the layer.

    Example:
        >>> slope = ElevationMap(torch.tensor([[3.0, 3.0], [1.0, 1.0]]), (0.0, 0.0), cell=1.0)
        >>> slope.height_at(torch.tensor([[0.0, 0.25], [0.5, 0.0], [9.0, 0.0]]))
        tensor([2., 3., nan])
    """

    heights: Tensor
    center: tuple[float, float]
    cell: float
    layer: str = "elevation"

    def height_at(self, xy: Tensor) -> Tensor:
        """Returns the heights at points ``xy [..., 2]`` (m): ``[...]``; NaN in cells that are unknown or outside.

        Between the middles of cells, heights are interpolated linearly, without the neighbors that are unknown.
        """
        last = torch.tensor(self.heights.shape, device=xy.device) - 1
        place = (xy.new_tensor(self.center) - xy) / self.cell + last / 2
        own = place.round().long()
        known = ((own >= 0) & (own <= last)).all(-1) & ~self._of(own, last).isnan()
        total = weight = torch.zeros_like(place[..., 0])
        for corner in itertools.product((0, 1), repeat=2):
            index = place.floor().long() + torch.tensor(corner, device=xy.device)
            height = self._of(index, last)
            share = (1 - (place - index).abs()).prod(-1).masked_fill(height.isnan(), 0.0)
            total, weight = total + share * height.nan_to_num(), weight + share
        return (total / weight).masked_fill(~known, torch.nan)

    def _of(self, index: Tensor, last: Tensor) -> Tensor:
        """Returns the heights of cells ``[..., 2]``, and of the nearest ones for those outside."""
        return self.heights[tuple(index.clamp(torch.zeros_like(last), last).unbind(-1))]
