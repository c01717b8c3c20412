"""Renderers of the worlds of a simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from torch import Tensor

from rover_rl.sims.base import View
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds import World

if TYPE_CHECKING:
    from rover_rl.sims.rendering.opengl import OpenGLRenderer
    from rover_rl.sims.rendering.renderer import Renderer

    AnyRenderer: TypeAlias = Renderer | OpenGLRenderer


class RendererCache:
    """One renderer per world, created on first use.

    PyBullet is imported with the first renderer, so that simulators without it start faster. If it is not installed,
    MuJoCo renders.

    Args:
        robot: robot model.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._renderers: dict[World, AnyRenderer] = {}

    def render(
        self, world: World, pose: Tensor, view: View, width: int, height: int, goal: Tensor | None = None
    ) -> Tensor:
        """Renders a rover at a pose, with a post at its goal.

        Args:
            world: world of the rover.
            pose: position (m) and unit quaternion (x, y, z, w) of the base frame, ``[7]``, on any device.
            view: ``"chase"`` (from behind) or ``"top"`` (from above).
            width: width of the image, pixels.
            height: height of the image, pixels.
            goal: position of the goal, ``[2]``, m. ``None`` draws no goal.

        Returns:
            RGB image, uint8 ``[height, width, 3]``.

        Raises:
            ValueError: if the view is unknown.
            ImportError: if neither PyBullet nor MuJoCo with OpenGL is available.
        """
        if world not in self._renderers:
            self._renderers[world] = self._make(world)
        position, orientation = pose.double().cpu().split((3, 4))
        return self._renderers[world].render(position, orientation, view, width, height, goal)

    def close(self) -> None:
        """Closes all renderers. Idempotent; rendering after this creates new ones."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()

    def _make(self, world: World) -> AnyRenderer:
        try:
            from rover_rl.sims.rendering.renderer import Renderer
        except ImportError:
            return self._make_without_bullet(world)
        return Renderer(world, self._robot)

    def _make_without_bullet(self, world: World) -> AnyRenderer:
        try:
            from rover_rl.sims.rendering.opengl import OpenGLRenderer
        except ImportError as error:
            raise ImportError(
                "pictures need PyBullet (pip install 'rover_rl[bullet]', which needs a compiler) or MuJoCo with OpenGL "
                "(pip install 'rover_rl[mujoco]')"
            ) from error
        return OpenGLRenderer(world, self._robot)
