"""Hills: rolling ground with plateaus and hollows, whose edges are steep faces and, here and there, gentle ramps."""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import binary_erosion

from rover_rl.worlds.generators import layouts
from rover_rl.worlds.generators.layouts import scaled, smoothstep, square
from rover_rl.worlds.terrain import Terrain
from rover_rl.worlds.world import World

SIDE, CELL = 24.0, 0.25
HALF_TASK, HALF_BOUNDS = 6.0, 10.0
ROLLING = (0.1, 0.14, 0.17)
"""Standard deviation of the height of the rolling ground at difficulty 0, 0.5 and 1, m."""
FACE_HEIGHT = (0.5, 0.75, 1.0)
"""Height of the steep faces, m."""
RAMPS = (-1.0, -0.6, -0.3)
"""Level above which a random field of standard deviation 1 turns faces into ramps."""
LEVELS = (-1.0, 0.8)
"""Levels of another such field: hollows lie below the first, plateaus above the second."""
FACE, RAMP = 1.2, 6.0
"""Difference of that field between the foot and the top of a face and of a ramp."""
CONNECTED, SPACIOUS = 0.6, 0.3
"""Minimum fraction of the gentle ground of the task area, and of all of it, that is connected for the rover."""
ERODED = np.ones((3, 3), dtype=bool)
"""Cells around a cell that must be gentle, too: half a rover in each direction."""


def hills(seed: int = 0, difficulty: float = layouts.DEFAULT) -> World:
    """Creates hills: rolling ground with steep faces, which a rover has to drive around.

    Ground steeper than 25 degrees is not passable. With the difficulty, faces get higher and steeper, ramps between the
    levels rarer, and the ground between the faces rougher. At least 60 % of the gentle ground of the task area is
    connected. The lidar sees a face from below, and not from above.
    """
    rng, task = np.random.default_rng(seed), layouts.in_square(HALF_TASK, CELL, round(SIDE / CELL))
    while True:
        heights = _ground(rng, difficulty)
        if layouts.is_connected(binary_erosion(layouts.gentle_cells(heights, CELL), ERODED), task, CONNECTED, SPACIOUS):
            break
    terrain = Terrain(torch.from_numpy(heights), CELL)
    return World("hills", terrain, spawn_range=square(HALF_TASK), bounds=square(HALF_BOUNDS))


def _ground(rng: np.random.Generator, difficulty: float) -> np.ndarray:
    shape = (round(SIDE / CELL) + 1,) * 2
    wavelengths = ((5.0, 20.0), (6.0, 16.0), (4.0, 12.0))
    rolling, level, gentle = (layouts.relief(rng, shape, CELL, lengths) for lengths in wavelengths)
    ramps = smoothstep((gentle - scaled(difficulty, *RAMPS)) / 0.6)
    width = FACE + (RAMP - FACE) * ramps
    # The middle of an edge stays where it is, however wide the edge.
    steps = sum(smoothstep((level - at) / width + 0.5) for at in LEVELS)
    heights = scaled(difficulty, *ROLLING) * rolling + scaled(difficulty, *FACE_HEIGHT) * steps
    return heights - heights[shape[0] // 2, shape[1] // 2]
