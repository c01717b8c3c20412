"""Steps of paths between the cells of a grid, in 32 directions, and orientations of a rover.

An orientation is a heading without front and back: orientation k of 32 is the yaw ``2 pi k / 64``, or its opposite.
"""

from __future__ import annotations

import math
from fractions import Fraction
from functools import reduce
from itertools import pairwise

import numpy as np

LONGEST = 3
"""Greatest extent of a step along an axis, in cells."""
ORIENTATIONS = 32
"""Number of orientations."""
ALL_ORIENTATIONS = 2**ORIENTATIONS - 1
"""Mask with all orientations."""


def _crossed_cells(step: tuple[int, int]) -> list[tuple[int, int]]:
    """Returns the cells that a straight line from the center of cell (0, 0) to that of another cell runs through.

    Cells that the line only touches in a corner do not count.
    """
    # Shares of the line at which it crosses the borders between cells, as exact fractions.
    borders = {Fraction(2 * k + 1, 2 * abs(side)) for side in step for k in range(abs(side))}
    shares = sorted({Fraction(0), Fraction(1), *borders})
    middles = [(a + b) / 2 for a, b in pairwise(shares)]
    return [(math.floor(t * step[0] + Fraction(1, 2)), math.floor(t * step[1] + Fraction(1, 2))) for t in middles]


_SIDES = range(-LONGEST, LONGEST + 1)
STEPS = sorted(
    ((x, y) for x in _SIDES for y in _SIDES if math.gcd(x, y) == 1), key=lambda step: math.atan2(*step[::-1])
)
"""Steps ``(x, y)`` to other cells in 32 directions, in cells, counter-clockwise."""
STEP_ORIENTATIONS = [round(math.atan2(y, x) / math.pi * ORIENTATIONS) % ORIENTATIONS for x, y in STEPS]
"""Orientation that is nearest to the direction of each step."""


def free_steps(fits: np.ndarray) -> np.ndarray:
    """Returns the steps that are free from each cell: bit k of uint32 ``[rows, columns]`` is step k.

    The orientation of a step must fit in all cells that it runs through.

    Args:
        fits: orientations that fit in each cell, as bits ``[rows, columns]``; 0 in cells that are not passable.
    """
    rows, columns = fits.shape
    around = np.pad(fits.astype(np.uint32), LONGEST)
    steps = np.zeros_like(fits, dtype=np.uint32)
    for k, (step, orientation) in enumerate(zip(STEPS, STEP_ORIENTATIONS, strict=True)):
        crossed = [around[LONGEST + y :, LONGEST + x :][:rows, :columns] for x, y in _crossed_cells(step)]
        free = (reduce(np.bitwise_and, crossed) >> np.uint32(orientation)) & np.uint32(1)
        steps |= free << np.uint32(k)
    return steps
