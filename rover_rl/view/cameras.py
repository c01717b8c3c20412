"""Cameras of a page: one that follows a rover, one from above, and a free one.

The follow camera moves the world, not the camera: the pages stay free to orbit and zoom, and nothing lags behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeAlias

import numpy as np
import torch
import viser

from rover_rl.worlds import World
from rover_rl.worlds.region import union

Vector: TypeAlias = Sequence[float] | np.ndarray
Mode = Literal["follow", "top", "free"]
MODES: tuple[Mode, ...] = ("follow", "top", "free")
ROOT = "/world"  # scene node of everything but light and sky, which the cameras move
BEHIND, OVER_WALLS = (2.8, 1.5), (2.0, 3.4)
"""Distances of the follow camera behind and above the rover at first, m, in the open and among walls."""
WALL = 0.8  # height from which on obstacles are walls, m: the median of their tops
MARGIN = 6.0  # width of what the camera sees from above around starts and goals, m
LOOK_AT = (0.0, 0.0, 0.2)  # point that the cameras look at, relative to the rover, m
SIGHT = 150.0  # distance up to which a click finds the ground, m
_STEP = 0.05  # distance between two points of the line of sight that are compared with the ground, m
_SMOOTHING = 0.2  # share of the way to the rover's height that the camera goes in a frame


class Cameras:
    """Cameras of all clients of a page."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self.mode, self._offset = server, MODES[0], np.zeros(3)
        self._yaw, self._span, self._center, self._steep = 0.0, 10.0, np.zeros(3), False
        self._root = server.scene.add_frame(ROOT, show_axes=False)
        server.on_client_connect(self._aim)

    def enter(self, world: World) -> None:
        """Sees a new world as a whole from above, and over its walls from behind a rover."""
        tops = [(one.vertices[:, 2] - world.height_at(one.vertices[:, :2])).max() for one in world.obstacles]
        self._steep = bool(tops) and torch.stack(tops).median().item() > WALL
        (left, right), (bottom, top) = union(world.spawn_range, world.goal_range)
        self._span = max(right - left, top - bottom) + MARGIN
        self._center = np.array(((left + right) / 2, (bottom + top) / 2, 0.0))
        self.select(self.mode)

    def select(self, mode: Mode) -> None:
        """Selects a camera for all clients. The free one starts where the last one was."""
        self.mode = mode
        if mode == "top":
            self._move(-self._center)
        if mode != "free":
            for client in self._server.get_clients().values():
                self._aim(client)

    def follow(self, position: np.ndarray, yaw: float) -> None:
        """Lets the follow camera see a rover at ``position [3]`` (m) with a heading (rad)."""
        self._yaw = yaw
        if self.mode != "follow":
            return
        height = self._offset[2] + _SMOOTHING * (-position[2] - self._offset[2])
        far = abs(position[2] + self._offset[2]) > 1.0
        self._move(np.array((-position[0], -position[1], -position[2] if far else height)))

    def ground_at(self, world: World, eye: Vector, toward: Vector) -> tuple[float, float] | None:
        """Point of the ground in a direction from the camera, x and y (m); ``None`` for the sky."""
        start, direction = np.array(eye) - self._offset, np.array(toward) / np.linalg.norm(toward)
        points = torch.from_numpy(start + np.arange(0, SIGHT, _STEP)[:, None] * direction)
        (left, right), (bottom, top) = world.terrain.extent
        x, y, z = points.unbind(-1)
        on_terrain = (left <= x) & (x <= right) & (bottom <= y) & (y <= top)
        below = (on_terrain & (z <= world.height_at(points[:, :2]))).nonzero()
        return None if not len(below) else (x[below[0, 0]].item(), y[below[0, 0]].item())

    def _move(self, offset: np.ndarray) -> None:
        self._offset = self._root.position = offset

    def _aim(self, client: viser.ClientHandle) -> None:
        """Puts the camera of a client to where its mode has it at first."""
        client.camera.up_direction = (0.0, 1.0, 0.0) if self.mode == "top" else (0.0, 0.0, 1.0)
        client.camera.position, client.camera.look_at = self.place(), LOOK_AT

    def place(self) -> np.ndarray:
        """Where the camera is at first, ``[3]``, m: behind the rover, or above the world."""
        if self.mode == "top":
            return np.array((0.0, -0.01, 1.05 * self._span))
        behind, above = OVER_WALLS if self._steep else BEHIND
        return np.array((-behind * np.cos(self._yaw), -behind * np.sin(self._yaw), above))
