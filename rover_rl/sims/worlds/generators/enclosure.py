"""Walls around a floor."""

from __future__ import annotations

import numpy as np

from rover_rl.sims.worlds.obstacles import Obstacle, boxes

THICKNESS, HEIGHT = 0.2, 2.0


def enclosing_walls(side: float) -> tuple[Obstacle, ...]:
    """Creates four walls just outside a square floor around the origin, so that all of the floor is free.

    Args:
        side: side length of the floor, m.
    """
    middle, length = (side + THICKNESS) / 2, side + 2 * THICKNESS
    centers = np.array([(0, -middle), (0, middle), (-middle, 0), (middle, 0)])
    along_x, along_y = (length, THICKNESS, HEIGHT), (THICKNESS, length, HEIGHT)
    return boxes(np.column_stack((centers, np.full(4, HEIGHT / 2))), [along_x, along_x, along_y, along_y])
