"""Scans on maps of seen obstacles as plain tensor operations, for export: what ``scan_kernels`` computes.

A map is two numbers for each cell here, ``[N, row, column]`` in the order of the window, so that they move when the
window does. One holds the evidence of an obstacle and the box that it has been seen in: integers in a tensor of floats,
which are exact. The other is the height of the ground.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor

from rover_rl.envs.seen_map.cell_kernels import (
    CELL,
    CLOSED,
    DOUBTFUL,
    HALF,
    MAX_TILT,
    MOST,
    OCCUPIED,
    OPEN,
    PARTS,
    SIZE,
    SUSPECTED,
    UNSEEN,
    Clearance,
)
from rover_rl.envs.seen_map.scan_kernels import (
    AHEAD,
    FARTHEST_HEIGHT,
    HIT,
    LOWEST,
    NO_GAP,
    REACH,
    ROUGH_TILT,
    STRETCH,
    WAY,
)

_GAP_CELLS = math.ceil(NO_GAP) - 1
"""Largest number of cells between the ends of two neighboring beams that count as one obstacle."""
_CODE = 16
"""Number of values of a digit of a map: evidence, and the four sides of the box. All are below."""
_CLOSED_CODE = _CODE - 1
"""Digit that stands for the evidence of a cell that is closed."""
_SIDES = 4
"""Number of sides of a box: ``PARTS - 1 - first`` and ``last`` along x, and along y. Larger ones are larger boxes."""

Vectors: TypeAlias = tuple[Tensor, Tensor, Tensor]
"""x, y and z of vectors in the world's frame."""
Points: TypeAlias = tuple[Tensor, Tensor, Tensor]
"""Points in the world: x and y, in cells, and which of them count, ``[N, n]`` each."""


class Lidar(NamedTuple):
    """A lidar on a rover.

    Attributes:
        directions: cosine and sine of the angle of each reading in the frame of the lidar, ``[P, 2]``.
        mount: position of the lidar in the frame of the rover, whose origin is on the ground, ``[3]``, m.
        max_range: range at which a beam has hit nothing, m.
    """

    directions: Tensor
    mount: Tensor
    max_range: float


class Cells(NamedTuple):
    """Content of the cells of maps.

    Attributes:
        evidence: evidence of an obstacle, ``[N, SIZE, SIZE]``.
        sides: sides of the box in which it has been seen, ``[N, 4, SIZE, SIZE]``; -1 in cells that are not occupied.
    """

    evidence: Tensor
    sides: Tensor


def moved_window(cells: Tensor, shift: Tensor, entering: float = 0.0) -> Tensor:
    """Returns the maps ``[N, SIZE, SIZE]`` of windows that have moved by ``shift [N, 2]`` cells along x and y.

    Args:
        cells: maps before.
        shift: ways of the windows, in cells.
        entering: value of the cells that enter.
    """
    every = torch.arange(SIZE, device=cells.device)
    # A shift by more clears the window as one by its size does.
    column, row = (every + shift.clamp(-SIZE, SIZE).long()[:, :, None]).unbind(1)
    stays = ((row >= 0) & (row < SIZE))[:, :, None] & ((column >= 0) & (column < SIZE))[:, None]
    source = row.clamp(0, SIZE - 1)[:, :, None] * SIZE + column.clamp(0, SIZE - 1)[:, None]
    moved = cells.flatten(1).gather(1, source.flatten(1)).reshape(cells.shape)
    return torch.where(stays, moved, entering)


def unpacked(cells: Tensor) -> Cells:
    """Returns the content of the cells of maps ``[N, SIZE, SIZE]``."""
    digits = []
    for _ in range(1 + _SIDES):
        rest = (cells / _CODE).floor()
        digits.append(cells - _CODE * rest)
        cells = rest
    evidence = torch.where(digits[0] == _CLOSED_CODE, float(CLOSED), digits[0])
    sides = torch.stack(digits[1:], 1)
    return Cells(evidence, torch.where(evidence[:, None] >= OCCUPIED, sides, -1.0))


def packed(cells: Cells) -> Tensor:
    """Returns maps ``[N, SIZE, SIZE]`` with a content."""
    number = torch.zeros_like(cells.evidence)
    for side in reversed(cells.sides.clamp(min=0.0).unbind(1)):
        number = _CODE * number + side
    return _CODE * number + cells.evidence.clamp(max=_CLOSED_CODE)


def tilted(pose: Tensor) -> Tensor:
    """Returns whether rovers tilt as on rough ground, bool ``[N, 1]``, from their poses ``[N, 5]``."""
    return pose[:, 2:3].cos() * pose[:, 3:4].cos() < math.cos(ROUGH_TILT)


def waited(places: Tensor, waits: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the places around which rovers are, ``[N, 2]``, m, and their numbers of scans there, ``[N, 1]``.

    Args:
        places: places before, ``[N, 2]``, m.
        waits: numbers of scans before, ``[N, 1]``. 0 at the start of an episode.
        pose: x, y (m), pitch, roll, yaw (rad) and z (m) of the rovers, ``[N, 6]``.
    """
    away = (pose[:, :2] - places).square().sum(-1, keepdim=True).sqrt() > WAY
    leaves = away | (waits == 0)
    return torch.where(leaves, pose[:, :2], places), torch.where(leaves, 1.0, waits + 1)


def with_scan(
    cells: Cells,
    heights: Tensor,
    center: Tensor,
    rough: Tensor,
    halted: Tensor,
    corners: Tensor,
    pose: Tensor,
    readings: Tensor,
    lidar: Lidar,
) -> tuple[Cells, Tensor]:
    """Returns the content and the heights of maps with a scan added to each.

    Args:
        cells: content before.
        heights: heights of the ground before, ``[N, SIZE, SIZE]``, m.
        center: cells in the middle of the windows, ``[N, 2]``.
        rough: whether the ground is rough, bool ``[N, 1]``.
        halted: rovers on whose routes a cell is closed, bool ``[N, 1]``.
        corners: x and y of the first corners of the routes before, ``[N, 2]``, m.
        pose: x, y (m), pitch, roll, yaw (rad) and z (m) of the rovers, ``[N, 6]``.
        readings: lidar readings, ``[N, P]``, m.
        lidar: the lidar.
    """
    cos, sin = pose[:, 4:5].cos(), pose[:, 4:5].sin()
    # Position of the lidar, in cells.
    x = (pose[:, :1] + lidar.mount[0] * cos - lidar.mount[1] * sin) / CELL
    y = (pose[:, 1:2] + lidar.mount[0] * sin + lidar.mount[1] * cos) / CELL
    ahead, left = _axes(pose)
    lengths, directions = readings / CELL, lidar.directions
    x_beam, y_beam, z_beam = (
        lengths * (directions[:, 0] * one + directions[:, 1] * other) for one, other in zip(ahead, left, strict=True)
    )
    beams = (x_beam, y_beam, z_beam)
    ends = _ends(beams, readings, lidar.max_range)
    up = _cross(ahead, left)
    steep = _is_steep(beams, up, lidar.mount[2] / CELL)
    hits = ends & (beams[2] > LOWEST) & (steep | ~rough)
    passed = _counts(center, _passed(x, y, beams))
    x_end, y_end = x + beams[0], y + beams[1]
    hit, gap, close = (
        (_counts(center, points), _boxes(center, points))
        for points in (
            (x_end, y_end, hits),
            _between(x, y, beams, hits),
            _joined(_uphill(pose, cos, sin), (*_on_route(pose, corners), halted)),
        )
    )
    doubt = _counts(center, (x_end, y_end, ends & rough & ~hits))
    # Beams that pass take 1 each, and those that end add HIT each, in any order: one stage follows the other.
    evidence = (cells.evidence - passed).clamp(min=0.0)
    sides = torch.where(evidence[:, None] >= OCCUPIED, cells.sides, -1.0)
    evidence = (evidence + HIT * hit[0]).clamp(max=MOST)
    evidence = torch.where(gap[0] > 0, evidence.clamp(min=OCCUPIED), evidence)
    # Beams do not change a closed cell. Ends of beams do not widen its box, but what is between them does.
    was_closed = cells.evidence > MOST
    evidence = torch.where(was_closed, float(CLOSED), evidence)
    sides = torch.where(was_closed[:, None], cells.sides, torch.maximum(sides, hit[1]))
    sides = torch.maximum(sides, gap[1])
    evidence = torch.where(doubt > 0, evidence.clamp(min=SUSPECTED), evidence)
    z = pose[:, 5:] + sum(lidar.mount[axis] * part[2] for axis, part in enumerate((ahead, left, up)))
    shown = (readings < lidar.max_range) & (torch.maximum(beams[0].abs(), beams[1].abs()) < FARTHEST_HEIGHT) & rough
    ground = _joined((x_end, y_end, shown), (pose[:, :1] / CELL, pose[:, 1:2] / CELL, rough))
    heights = torch.maximum(heights, _tops(center, ground, torch.cat((z + CELL * beams[2], pose[:, 5:]), 1)))
    wall = _walls(heights) & rough[..., None] & (evidence != CLOSED)
    evidence = torch.where(wall, float(CLOSED), evidence)
    sides = torch.where(wall[:, None], torch.maximum(sides, _middle(sides)), sides)
    return Cells(torch.where(close[0] > 0, float(CLOSED), evidence), torch.maximum(sides, close[1])), heights


def levels(cells: Cells, rough: Tensor, clearance: Clearance) -> Tensor:
    """Returns the level of each cell, ``[N, SIZE, SIZE]``, on ground that is rough ``[N, 1]`` or not.

    The surroundings of a cell at an edge of the window reach over to the opposite edge.
    """
    level = torch.where(cells.evidence >= OCCUPIED, 0.0, _levels_by_distance(cells.sides, clearance))
    suspected = ((cells.evidence == SUSPECTED) & rough[..., None]).to(level.dtype)
    offset = torch.arange(-clearance.reach, clearance.reach + 1, device=level.device)
    near = PARTS * PARTS * (offset.square() + offset.square()[:, None]) < clearance.doubt
    around = F.pad(suspected[:, None], (clearance.reach,) * 4, mode="circular")
    count = F.conv2d(around, near[None, None].to(level.dtype))[:, 0]
    return torch.where(count > 0.5, level.clamp(max=DOUBTFUL), level)


def _levels_by_distance(sides: Tensor, clearance: Clearance) -> Tensor:
    """Returns the level of each cell by the distance of its middle from the nearest of boxes with the given sides."""
    reach = clearance.reach
    offset = torch.arange(-reach, reach + 1, device=sides.device)
    around = F.pad(sides, (reach,) * 4, mode="circular")
    # Squared distances along x and along y, in parts, from the box in a cell to the middle of one `offset` cells away.
    middle = (PARTS * offset + PARTS // 2).to(around.dtype)[None, :, None, None]
    x, y = (
        torch.maximum(PARTS - 1 - pair[:, :1] - middle, middle - pair[:, 1:] - 1).clamp(min=0.0).square()
        for pair in around.chunk(2, 1)
    )
    free = around[:, :1] < 0
    x = torch.where(free, float(clearance.wide), x)
    squares = []
    for column, part in enumerate(x.unbind(1)):
        # The obstacle is at the opposite side.
        start = 2 * reach - column
        squares.append((part[:, None] + y)[..., start : start + SIZE])
    nearest = _lowest(squares)
    rows = [part[:, 2 * reach - row :][:, :SIZE] for row, part in enumerate(nearest.unbind(1))]
    square = _lowest(rows)
    limits = (clearance.tight, clearance.near, clearance.wide)
    return OPEN - sum((square < limit).to(square.dtype) for limit in limits)


def _lowest(values: list[Tensor]) -> Tensor:
    lowest = values[0]
    for value in values[1:]:
        lowest = torch.minimum(lowest, value)
    return lowest


def _axes(pose: Tensor) -> tuple[Vectors, Vectors]:
    """Returns the axes ahead and to the left of rovers in the world's frame, from poses ``[N, 6]``."""
    cos_pitch, cos_roll, cos = pose[:, 2:5].cos().split(1, -1)
    sin_pitch, sin_roll, sin = pose[:, 2:5].sin().split(1, -1)
    # Columns of Rz(yaw) Ry(pitch) Rx(roll).
    ahead = (cos_pitch * cos, cos_pitch * sin, -sin_pitch)
    left = (
        sin_roll * sin_pitch * cos - cos_roll * sin,
        sin_roll * sin_pitch * sin + cos_roll * cos,
        sin_roll * cos_pitch,
    )
    return ahead, left


def _cross(one: Vectors, other: Vectors) -> Vectors:
    """Returns the cross products of vectors."""
    (a, b, c), (x, y, z) = one, other
    return b * z - c * y, c * x - a * z, a * y - b * x


def _ends(beams: Vectors, readings: Tensor, max_range: float) -> Tensor:
    """Returns which beams, in cells, have hit something in the window, bool ``[N, P]``."""
    return (readings < max_range) & (torch.maximum(beams[0].abs(), beams[1].abs()) < REACH)


def _is_steep(beams: Vectors, up: Vectors, height: Tensor) -> Tensor:
    """Returns whether the ground rises too steeply from below the lidar to the ends of beams, bool ``[N, P]``.

    Args:
        beams: vectors from the lidar, in cells.
        up: unit vectors from the ground below the lidar to the lidar.
        height: height of the lidar, in cells.
    """
    x, y, z = (beam + height * part for beam, part in zip(beams, up, strict=True))
    return z > math.tan(MAX_TILT) * (x * x + y * y).sqrt()


def _passed(x: Tensor, y: Tensor, beams: Vectors) -> Points:
    """Returns points in the cells that beams pass, up to 1.5 cells before their ends."""
    crossed = torch.maximum(beams[0].abs(), beams[1].abs())[..., None]
    number = torch.arange(1, REACH + 1, device=x.device)
    part = number / crossed
    counts = number <= crossed - 1.5
    along, across = x[..., None] + part * beams[0][..., None], y[..., None] + part * beams[1][..., None]
    return along.flatten(1), across.flatten(1), counts.flatten(1)


def _between(x: Tensor, y: Tensor, beams: Vectors, hits: Tensor) -> Points:
    """Returns points between the ends of neighboring beams. The last beam is a neighbor of the first one."""
    gap_x, gap_y = (beam.roll(-1, 1) - beam for beam in beams[:2])
    both = hits & hits.roll(-1, 1) & ((gap_x * gap_x + gap_y * gap_y).sqrt() < NO_GAP)
    steps = torch.maximum(gap_x.abs(), gap_y.abs()).ceil()[..., None]
    number = torch.arange(1, _GAP_CELLS + 1, device=x.device)
    part = number / steps
    along = (x + beams[0])[..., None] + part * gap_x[..., None]
    across = (y + beams[1])[..., None] + part * gap_y[..., None]
    return along.flatten(1), across.flatten(1), (both[..., None] & (number < steps)).flatten(1)


def _uphill(pose: Tensor, cos: Tensor, sin: Tensor) -> Points:
    """Returns a point uphill of the rover, which counts if the rover stands on a steep slope."""
    cos_pitch, cos_roll = pose[:, 2:4].cos().split(1, -1)
    sin_pitch, sin_roll = pose[:, 2:4].sin().split(1, -1)
    # The rover's vertical axis leans downhill.
    down_x = cos_roll * sin_pitch * cos + sin_roll * sin
    down_y = cos_roll * sin_pitch * sin - sin_roll * cos
    scale = AHEAD / (down_x * down_x + down_y * down_y).sqrt()
    x, y = pose[:, :1] / CELL - scale * down_x, pose[:, 1:2] / CELL - scale * down_y
    return x, y, cos_pitch * cos_roll < math.cos(MAX_TILT)


def _on_route(pose: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """Returns x and y of a point ahead of the rover on the way to a corner, in cells."""
    way_x, way_y = (corners - pose[:, :2]).split(1, -1)
    scale = AHEAD / (way_x * way_x + way_y * way_y).sqrt().clamp(min=1e-6)
    return pose[:, :1] / CELL + scale * way_x, pose[:, 1:2] / CELL + scale * way_y


def _walls(heights: Tensor) -> Tensor:
    """Returns the cells halfway between two whose heights differ too much, bool ``[N, SIZE, SIZE]``.

    Only cells in the middle of the window are compared, where heights change.
    """
    border = HALF - FARTHEST_HEIGHT - 2 * STRETCH
    middle = heights[:, border : SIZE - border, border : SIZE - border]
    size = middle.shape[-1]
    closed = torch.zeros_like(middle)
    for row in range(-STRETCH, STRETCH + 1):
        for column in range(-STRETCH, STRETCH + 1):
            distance = math.hypot(row, column)
            if 0 < distance <= STRETCH:
                limit = math.tan(MAX_TILT) * CELL * (distance + 1.0)
                # Pairs of a cell and a higher one, which is (row, column) away.
                lower, higher = _overlap(middle, row, column)
                steep = (lower > UNSEEN) & (higher - lower > limit)
                # Rounded to the higher cell.
                half_row, half_column = (int(math.copysign((abs(offset) + 1) // 2, offset)) for offset in (row, column))
                first_row, first_column = max(0, -row) + half_row, max(0, -column) + half_column
                left, right = first_column, size - first_column - steep.shape[-1]
                above, below = first_row, size - first_row - steep.shape[-2]
                closed = torch.maximum(closed, F.pad(steep.to(closed.dtype), (left, right, above, below)))
    return F.pad(closed, (border,) * 4) > 0


def _overlap(cells: Tensor, row: int, column: int) -> tuple[Tensor, Tensor]:
    """Returns the cells that have another one (row, column) away in the map, and these others."""
    size = cells.shape[-1]
    rows, columns = (slice(max(0, -offset), size - max(0, offset)) for offset in (row, column))
    other_rows, other_columns = (slice(max(0, offset), size - max(0, -offset)) for offset in (row, column))
    return cells[:, rows, columns], cells[:, other_rows, other_columns]


def _middle(sides: Tensor) -> Tensor:
    """Returns the sides of the box of a point in the middle of a cell, ``[4, 1, 1]``."""
    part = PARTS // 2
    return sides.new_tensor([PARTS - 1 - part, part] * 2)[:, None, None]


def _joined(one: Points, other: Points) -> Points:
    """Returns the points of both."""
    x, y, counts = (torch.cat(parts, 1) for parts in zip(one, other, strict=True))
    return x, y, counts


def _addresses(center: Tensor, points: Points) -> Tensor:
    """Returns the address of each point's cell in the window, int64 ``[N, n]``; any for those that do not count."""
    x, y, counts = points
    column, row = (
        (torch.where(counts, position.floor(), 0.0) - center[:, axis : axis + 1] + HALF).long() % SIZE
        for axis, position in enumerate((x, y))
    )
    return row * SIZE + column


def _counts(center: Tensor, points: Points) -> Tensor:
    """Returns the number of points in each cell of the window, ``[N, SIZE, SIZE]``."""
    numbers = center.new_zeros(len(center), SIZE * SIZE)
    added = numbers.scatter_add(1, _addresses(center, points), points[2].to(center.dtype))
    return added.reshape(-1, SIZE, SIZE)


def _tops(center: Tensor, points: Points, heights: Tensor) -> Tensor:
    """Returns the greatest of the heights ``[N, n]`` of the points in each cell; ``UNSEEN`` without any."""
    heights = torch.where(points[2], heights, UNSEEN)
    none = center.new_full((len(center), SIZE * SIZE), UNSEEN)
    return none.scatter_reduce(1, _addresses(center, points), heights, "amax").reshape(-1, SIZE, SIZE)


def _boxes(center: Tensor, points: Points) -> Tensor:
    """Returns the sides of the box of the points in each cell of the window, ``[N, 4, SIZE, SIZE]``; -1 without any."""
    x, y, counts = points
    parts = [((position - position.floor()) * PARTS).trunc().clamp(0, PARTS - 1) for position in (x, y)]
    sides = torch.stack([side for part in parts for side in (PARTS - 1 - part, part)], 1)
    sides = torch.where(counts[:, None], sides, -1.0)
    addresses = _addresses(center, points)[:, None].expand(-1, _SIDES, -1)
    none = center.new_full((len(center), _SIDES, SIZE * SIZE), -1.0)
    return none.scatter_reduce(2, addresses, sides, "amax").reshape(-1, _SIDES, SIZE, SIZE)
