"""Steps of paths between the cells of a grid, in 32 directions."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import pairwise

LONGEST = 3
"""Greatest extent of a step along an axis, in cells."""


def _crossed_cells(step: tuple[int, int]) -> list[tuple[int, int]]:
    """Returns the cells that a straight line from the center of cell (0, 0) to that of another cell runs through.

    Cells that the line only touches in a corner do not count.
    """
    # Shares of the line at which it crosses the borders between cells, as exact fractions.
    borders = {Fraction(2 * k + 1, 2 * abs(side)) for side in step for k in range(abs(side))}
    shares = sorted({Fraction(0), Fraction(1), *borders})
    middles = [(a + b) / 2 for a, b in pairwise(shares)]
    return [(math.floor(t * step[0] + Fraction(1, 2)), math.floor(t * step[1] + Fraction(1, 2))) for t in middles]


STEPS = {
    (x, y): _crossed_cells((x, y))
    for x in range(-LONGEST, LONGEST + 1)
    for y in range(-LONGEST, LONGEST + 1)
    if math.gcd(x, y) == 1
}
"""Steps ``(x, y)`` to other cells in 32 directions, in cells, and the cells that each runs through."""
TURNED_STEPS = sorted(STEPS, key=lambda step: math.atan2(step[1], step[0]))
"""Steps in the order of their directions, counter-clockwise."""
