"""Lines of sight past the obstacles of a world."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.native.warp import wp
from rover_rl.sims.rendering.kernels import light
from rover_rl.sims.rendering.launches import array, launch
from rover_rl.sims.worlds import World

FREE_FRACTION = 0.98
"""Fraction of a line of sight that must be free, less than 1 because its end may lie on an obstacle."""


class Sight:
    """Tells which points the obstacles of a world hide. The ground hides nothing.

    Args:
        world: world with the obstacles.
    """

    def __init__(self, world: World) -> None:
        self._mesh: wp.Mesh | None = None
        if world.obstacles:
            corners = [obstacle.vertices[obstacle.faces.flatten()].numpy() for obstacle in world.obstacles]
            vertices = np.concatenate(corners)
            self._mesh = wp.Mesh(array(vertices, wp.vec3), array(np.arange(len(vertices)), int))

    def hidden(self, eye: Tensor, points: Tensor) -> Tensor:
        """Returns whether an obstacle lies between ``eye [..., 3]`` and ``points [..., 3]`` (m): bool ``[...]``."""
        eye, points = torch.broadcast_tensors(eye, points)
        hidden = torch.zeros(points.shape[:-1], dtype=torch.uint8)
        if self._mesh is not None and hidden.numel():
            ends = [array(part.reshape(-1, 3).numpy(), wp.vec3) for part in (eye, points)]
            flags = wp.from_torch(hidden.view(-1))
            launch(light.find_hidden, flags.shape, [self._mesh.id, *ends, FREE_FRACTION, flags])
        return hidden.bool()
