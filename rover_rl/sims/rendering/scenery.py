"""Colors, light and goal post of all renderers."""

from __future__ import annotations

import torch
from torch import Tensor

from rover_rl.sims.worlds import World

GROUND = (0.62, 0.56, 0.48, 1.0)
"""Color of the ground: red, green, blue and opacity, 0 to 1."""
OBSTACLE = (0.45, 0.52, 0.60, 1.0)
"""Color of obstacles."""
GOAL = (0.10, 0.75, 0.25, 1.0)
"""Color of the post of the goal."""
POST_RADIUS = 0.08
"""Radius of the post of the goal, m."""
POST_LENGTH = 1.2
"""Length of the post of the goal, m."""
SUN = (-3.0, 2.0, 6.0)
"""Direction from which the light comes."""
FAR = 60.0
"""Distance of the far plane from the camera, m."""


def post_position(world: World, goal: Tensor | None) -> tuple[float, float, float]:
    """Returns the center of the post (m), which is far below the ground if there is no goal.

    Args:
        world: world that defines the ground.
        goal: position of the goal, ``[2]``, m, or ``None``.
    """
    if goal is None:
        return 0.0, 0.0, -1e3
    x, y = goal.tolist()
    ground = world.height_at(torch.tensor((x, y), dtype=torch.float64)).item()
    return x, y, ground + POST_LENGTH / 2
