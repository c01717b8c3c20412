"""Scans on maps of seen obstacles as plain tensor operations, for export: what ``scan_kernels`` computes.

Maps are in the order of the window here, ``[N, row, column]``: they move when the window does. All cell numbers are
integers in tensors of floats, and all sums are exact.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from rover_rl.envs.seen_map.scan_kernels import (
    CELL,
    HALF,
    HIT,
    LOWEST,
    MAX_TILT,
    MOST,
    NO_GAP,
    OCCUPIED,
    REACH,
    RINGS,
    SIZE,
    STEEP,
    UPHILL,
)

_GAP_CELLS = math.ceil(NO_GAP) - 1
"""Largest number of cells between the ends of two neighboring beams that count as one obstacle."""


def moved_window(evidence: Tensor, shift: Tensor) -> Tensor:
    """Returns the maps ``[N, SIZE, SIZE]`` of windows that have moved by ``shift [N, 2]`` cells along x and y."""
    every = torch.arange(SIZE, device=evidence.device)
    # A shift by more clears the window as one by its size does.
    column, row = (every + shift.clamp(-SIZE, SIZE).long()[:, :, None]).unbind(1)
    stays = ((row >= 0) & (row < SIZE))[:, :, None] & ((column >= 0) & (column < SIZE))[:, None]
    source = row.clamp(0, SIZE - 1)[:, :, None] * SIZE + column.clamp(0, SIZE - 1)[:, None]
    moved = evidence.flatten(1).gather(1, source.flatten(1)).reshape(evidence.shape)
    return torch.where(stays, moved, 0.0)


def with_scan(
    evidence: Tensor,
    center: Tensor,
    pose: Tensor,
    readings: Tensor,
    directions: Tensor,
    mount: Tensor,
    max_range: float,
) -> Tensor:
    """Returns the maps with a scan added to each.

    Args:
        evidence: evidence of an obstacle in each cell, ``[N, SIZE, SIZE]``.
        center: cells in the middle of the windows, ``[N, 2]``.
        pose: x, y (m), pitch, roll and yaw (rad) of the rovers, ``[N, 5]``.
        readings: lidar readings, ``[N, P]``, m.
        directions: cosine and sine of the angle of each reading in the frame of the lidar, ``[P, 2]``.
        mount: x and y of the lidar in the frame of the rover, ``[2]``, m.
        max_range: range at which a beam has hit nothing, m.
    """
    cos, sin = pose[:, 4:].cos(), pose[:, 4:].sin()
    # Position of the lidar, in cells.
    x = (pose[:, :1] + mount[0] * cos - mount[1] * sin) / CELL
    y = (pose[:, 1:2] + mount[0] * sin + mount[1] * cos) / CELL
    beams = _beams(pose, readings / CELL, directions)
    hits = _hits(beams, readings, max_range)
    passed = _passed(x, y, beams)
    ends = x + beams[0], y + beams[1], hits
    between = _between(x, y, beams, hits)
    counts = _counts(center, (passed, ends, between, _uphill(pose, cos, sin)))
    passes, hit, gap, steep = counts.reshape(-1, 4, SIZE, SIZE).unbind(1)
    # Beams that pass take 1 each, those that end add HIT each, whatever their order: one stage follows the other.
    read = ((evidence - passes).clamp(min=0.0) + HIT * hit).clamp(max=MOST)
    read = torch.where(gap > 0, read.clamp(min=OCCUPIED), read)
    return torch.where((evidence > MOST) | (steep > 0), float(STEEP), read)


def rings(evidence: Tensor) -> Tensor:
    """Returns the distance of each cell from the nearest occupied one, in cells (Chebyshev), at most ``RINGS``.

    The surroundings of a cell at an edge of the window reach over to the opposite edge.
    """
    occupied = (evidence >= OCCUPIED).to(evidence.dtype)[:, None]
    reached = F.pad(occupied, (RINGS - 1,) * 4, mode="circular")
    near = occupied
    for ring in range(1, RINGS):
        reached = F.max_pool2d(reached, 3, 1)
        rest = RINGS - 1 - ring
        near = near + reached[..., rest : rest + SIZE, rest : rest + SIZE]
    return RINGS - near[:, 0]


def _beams(pose: Tensor, lengths: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns x, y and z of beams in the world's frame, ``[N, P]``: see ``beam_of`` in ``scan_kernels``."""
    pitch, roll, yaw = pose[:, 2:].split(1, -1)
    aside = directions[:, 1] * roll.sin()
    forward = directions[:, 0] * pitch.cos() + aside * pitch.sin()
    left = directions[:, 1] * roll.cos()
    up = aside * pitch.cos() - directions[:, 0] * pitch.sin()
    along, across = forward * yaw.cos() - left * yaw.sin(), forward * yaw.sin() + left * yaw.cos()
    return lengths * along, lengths * across, lengths * up


def _hits(beams: tuple[Tensor, Tensor, Tensor], readings: Tensor, max_range: float) -> Tensor:
    """Returns which beams, in cells, end at an obstacle in the window, bool ``[N, P]``."""
    crossed = torch.maximum(beams[0].abs(), beams[1].abs())
    return (readings < max_range) & (crossed < REACH) & (beams[2] > LOWEST)


_Points = tuple[Tensor, Tensor, Tensor]
"""Points in the world: x and y, in cells, and which of them count."""


def _passed(x: Tensor, y: Tensor, beams: tuple[Tensor, Tensor, Tensor]) -> _Points:
    """Returns points in the cells that beams pass, up to 1.5 cells before their ends."""
    crossed = torch.maximum(beams[0].abs(), beams[1].abs())[..., None]
    number = torch.arange(1, REACH + 1, device=x.device)
    part = number / crossed
    counts = number <= crossed - 1.5
    return x[..., None] + part * beams[0][..., None], y[..., None] + part * beams[1][..., None], counts


def _between(x: Tensor, y: Tensor, beams: tuple[Tensor, Tensor, Tensor], hits: Tensor) -> _Points:
    """Returns points between the ends of neighboring beams. The last beam is a neighbor of the first one."""
    gap_x, gap_y = (beam.roll(-1, 1) - beam for beam in beams[:2])
    both = hits & hits.roll(-1, 1) & ((gap_x * gap_x + gap_y * gap_y).sqrt() < NO_GAP)
    steps = torch.maximum(gap_x.abs(), gap_y.abs()).ceil()[..., None]
    number = torch.arange(1, _GAP_CELLS + 1, device=x.device)
    part = number / steps
    along = (x + beams[0])[..., None] + part * gap_x[..., None]
    across = (y + beams[1])[..., None] + part * gap_y[..., None]
    return along, across, both[..., None] & (number < steps)


def _uphill(pose: Tensor, cos: Tensor, sin: Tensor) -> _Points:
    """Returns a point uphill of the rover, which counts if the rover stands on a steep slope."""
    pitch, roll = pose[:, 2:3], pose[:, 3:4]
    # Downhill is where the rover's vertical axis, Rz(yaw) Ry(pitch) Rx(roll) (0, 0, 1), points to.
    forward, left = roll.cos() * pitch.sin(), -roll.sin()
    scale = -UPHILL / (forward * forward + left * left).sqrt()
    x = pose[:, :1] / CELL + scale * (forward * cos - left * sin)
    y = pose[:, 1:2] / CELL + scale * (forward * sin + left * cos)
    return x, y, pitch.cos() * roll.cos() < math.cos(MAX_TILT)


def _counts(center: Tensor, kinds: tuple[_Points, ...]) -> Tensor:
    """Returns the number of points of each kind in each cell of the window, ``[N, kinds * SIZE * SIZE]``."""
    addresses, values = [], []
    for kind, (x, y, counts) in enumerate(kinds):
        column, row = (
            (torch.where(counts, position.floor(), 0.0).flatten(1) - center[:, axis : axis + 1] + HALF).long() % SIZE
            for axis, position in enumerate((x, y))
        )
        addresses.append((kind * SIZE + row) * SIZE + column)
        values.append(counts.flatten(1).to(x.dtype))
    zeros = center.new_zeros(len(center), len(kinds) * SIZE * SIZE)
    return zeros.scatter_add(1, torch.cat(addresses, 1), torch.cat(values, 1))
