"""Narrow passages: cells that a rover passes in some orientations only, where its footprint fits.

Discs along the x axis cover the footprint (:func:`rover_rl.robots.footprint.covering_discs`). It is free at the center
of a cell in an orientation, plus or minus half a bin of ``2 pi / 64``, with the margin m, if the nearest obstacle is at
least ``r + m + |x_i| pi / 64`` from the center of each disc of radius r: the last term covers the half bin.

A rectangle that moves along its length, by less than its length, sweeps what it covers at both ends. So the rover
drives straight from the center of a cell to that of another without touching if its footprint is free at both ends,
forward or backward. It turns on the spot while all orientations between are free. Chains of such motions join cells.

Gaps of 0.7 m are passable for Rover Zero however they lie on the grid, 99 % of those of 0.65 m, 12 % of those of 0.6 m
(120 gaps in a wall of 0.2 m at random offsets and angles).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.ndimage import label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rover_rl.native.warp import wp
from rover_rl.robots import Robot
from rover_rl.robots.footprint import covering_discs
from rover_rl.sims.free_space import cells
from rover_rl.sims.free_space.cells import ALL_ORIENTATIONS, ORIENTATIONS, CellGrid
from rover_rl.sims.free_space.kernels import fit_footprint

MARGIN = 0.02
"""Minimum distance of the footprint from obstacles at the center of a cell, m. It exceeds the error of interpolated
distances, 5 mm at obstacles like thin cylinders."""


def headings_of_bins() -> np.ndarray:
    """Cosine and sine of the 64 headings at the lower ends of the heading bins: ``[64, 2]``."""
    return cells.ring(2 * ORIENTATIONS, start=-math.pi).numpy()


def fit_orientations(robot: Robot, grid: CellGrid, room: np.ndarray, margin: float = MARGIN) -> np.ndarray:
    """Orientations in which the footprint at the center of each cell is free, with the ``margin`` (m): bits of uint32.

    ``room`` is the distance of the centers from the nearest obstacle, float64 ``[rows, columns]``, m.
    """
    centers, radius = covering_discs(robot)
    discs = centers[centers > -1e-9]
    radii = radius + margin + discs * math.pi / (2 * ORIENTATIONS)
    room = np.minimum(room, grid.distance_to_border())
    fits = np.empty(grid.shape, dtype=np.uint32)
    inputs = [room, grid.cell, robot.radius + margin, discs, radii, headings_of_bins(), fits]
    wp.launch(fit_footprint, len(room), inputs, device="cpu")
    return fits


def find_reach(
    robot: Robot, grid: CellGrid, room: np.ndarray, gentle: np.ndarray, roomy: np.ndarray, areas: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Cells that are connected to most goals: roomy ones, bool, and orientations in narrow ones, as bits.

    Roomy cells are connected by their sides. Narrow cells count only if they join roomy cells of the spawn and goal
    ``areas`` that are separate otherwise, and the robot turns in place, as it has to where two motions meet. They must
    be on ``gentle`` ground and have ``room``, the distance from the nearest obstacle, m.
    """
    parts, count = label(roomy)
    spawns, goals = (np.bincount(parts[roomy & area], minlength=count + 1) for area in areas)
    wanted = np.flatnonzero(spawns + goals)
    best = np.arange(count + 1) == goals.argmax()
    narrow = np.zeros(grid.shape, dtype=np.uint32)
    if len(wanted) > 1 and robot.drive.turns_in_place:
        fits = np.where(gentle, fit_orientations(robot, grid, room), np.uint32(0))
        fits[roomy] = ALL_ORIENTATIONS
        is_narrow = (fits != 0) & ~roomy
        of_parts, of_narrow = _components(fits, is_narrow, parts, count)
        rest = goals.copy()
        while rest.max() > 0 and rest.sum() > (goals @ best if narrow.any() else 0):
            component = of_parts[rest.argmax()]
            joined = of_parts == component
            rest[joined] = 0
            if joined[wanted].sum() > 1 and goals @ joined >= goals @ best:
                best = joined
                narrow[is_narrow] = (of_narrow == component) @ _BITS
    return roomy & best[parts], narrow


_BITS = np.uint32(1) << np.arange(ORIENTATIONS, dtype=np.uint32)


def _components(
    fits: np.ndarray, is_narrow: np.ndarray, parts: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """The component of what a rover can reach of each part ``[count + 1]`` and narrow pose ``[cells, 32]``.

    A rover takes steps from cell to cell in their orientation, forward or backward, and turns on the spot while all
    orientations between fit.
    """
    rows, columns = np.nonzero(is_narrow)
    nodes = np.arange(len(rows) * ORIENTATIONS).reshape(-1, ORIENTATIONS)
    # The number of a cell's first node, or of the node of its part.
    first = parts + nodes.size
    first[is_narrow] = nodes[:, 0]
    free, own = cells.free_steps(fits)[is_narrow], fits[is_narrow]
    starts, ends = [], []
    for k, ((x, y), orientation) in enumerate(zip(cells.STEPS, cells.STEP_ORIENTATIONS, strict=True)):
        taken = free & _BITS[k] > 0
        to = rows[taken] + y, columns[taken] + x
        starts.append(nodes[taken, orientation])
        ends.append(first[to] + np.where(is_narrow[to], orientation, 0))
    for k in range(ORIENTATIONS):
        turned = (own & _BITS[k - 1] > 0) & (own & _BITS[k] > 0)
        starts.append(nodes[turned, k - 1])
        ends.append(nodes[turned, k])
    start, end = np.concatenate(starts), np.concatenate(ends)
    graph = coo_array((np.ones(len(start), dtype=bool), (start, end)), shape=(nodes.size + count + 1,) * 2)
    components = connected_components(graph, directed=False)[1]
    return components[nodes.size :], components[: nodes.size].reshape(nodes.shape)


def orientations_of_bins(masks: np.ndarray) -> torch.Tensor:
    """Heading bins, as bits of int64, whose two ends are in orientations of ``masks [S]`` (uint32)."""
    both = masks.astype(np.uint64) | (masks.astype(np.uint64) << np.uint64(ORIENTATIONS))
    after = (both >> np.uint64(1)) | (both << np.uint64(2 * ORIENTATIONS - 1))
    return torch.from_numpy((both & after).view(np.int64))
