"""Renderers of the worlds of a simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from rover_rl.checks import check_at_least
from rover_rl.robots import Robot
from rover_rl.sims.base import View
from rover_rl.worlds import World

if TYPE_CHECKING:
    from rover_rl.sims.rendering.renderer import Renderer
    from rover_rl.worlds.movers.parts import Parts

MAX_SIDE = 8192
"""Largest width and height of an image, pixels."""


class RendererCache:
    """One renderer per world for a robot, created on first use."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._renderers: dict[World, Renderer] = {}

    def render(
        self,
        world: World,
        pose: Tensor,
        view: View,
        width: int,
        height: int,
        goal: Tensor | None = None,
        movers: Parts | None = None,
    ) -> Tensor:
        """Renders a rover from behind (``"chase"``) or above (``"top"``): uint8 ``[height, width, 3]``.

        ``pose`` is position (m) and quaternion (x, y, z, w) of the base frame, ``[7]``, ``goal`` that of a goal,
        ``[2]``, m, and ``movers`` are parts, one row. Raises ``ValueError`` if the view is unknown, the size out of
        range, or a visual shape cannot be rendered.
        """
        check_at_least(1, MAX_SIDE, width=width, height=height)
        # Importing them compiles nothing, but takes a second.
        from rover_rl.sims.rendering.renderer import Camera, Renderer

        if world not in self._renderers:
            self._renderers[world] = Renderer(world, self._robot)
        renderer, (position, turn) = self._renderers[world], pose.double().cpu().split((3, 4))
        camera = Camera.on(position, turn, renderer.sight, view)
        return renderer.render_from(camera, position, turn, width, height, goal, movers)

    def close(self) -> None:
        """Releases all renderers. Idempotent."""
        self._renderers.clear()
