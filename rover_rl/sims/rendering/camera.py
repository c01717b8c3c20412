"""Cameras that follow a rover, and the projection of points into their images."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rover_rl.sims.base import View
from rover_rl.sims.rendering.sight import Sight
from rover_rl.sims.rotations import quaternion_to_euler

FIELD_OF_VIEW = 60.0
"""Vertical field of view, degrees."""
NEAR = 0.05
"""Distance of the near plane from the camera, m."""
_TOP_HEIGHT = 12.0
"""Height of the top view's camera above the rover, m."""
_CHASE_DISTANCE = 2.55
"""Distance of the chase view's camera from the rover, m."""
_ELEVATIONS = torch.linspace(math.radians(30.5), math.radians(85), 20, dtype=torch.float64)
"""Elevation angles of the chase view, rad. The camera uses the first at which no obstacle hides the rover."""
_BODY_POINTS = torch.tensor([(x, y, 0.1) for x in (-0.25, 0.25) for y in (-0.25, 0.25)], dtype=torch.float64)
"""Points of the rover that must be visible, relative to its origin, m."""


@dataclass(frozen=True)
class Camera:
    """Camera in a world. Vectors are ``[3]``, float64.

    Attributes:
        eye: position of the camera, m.
        target: point at the center of the image, m.
        up: direction that points up in the image.
        sight: tells which points obstacles hide.
    """

    eye: Tensor
    target: Tensor
    up: Tensor
    sight: Sight

    @classmethod
    def on(cls, position: Tensor, orientation: Tensor, sight: Sight, view: View) -> Camera:
        """Creates the camera behind (``"chase"``) or above (``"top"``) a rover.

        The chase camera moves up when an obstacle hides the rover.

        Args:
            position: position of the rover, ``[3]``, m.
            orientation: orientation of the rover, unit quaternion (x, y, z, w), ``[4]``.
            sight: tells which points the obstacles of the world hide.
            view: ``"chase"`` or ``"top"``.

        Raises:
            ValueError: if the view is unknown.
        """
        position = position.double()
        up = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
        if view == "top":
            north = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
            return cls(position + _TOP_HEIGHT * up, position, north, sight)
        if view != "chase":
            raise ValueError(f"unknown view {view!r}; use 'chase' or 'top'")
        yaw = quaternion_to_euler(orientation)[2].item()
        ahead = torch.tensor((math.cos(yaw), math.sin(yaw), 0.0), dtype=torch.float64)
        eyes = position + _CHASE_DISTANCE * (_ELEVATIONS.sin()[:, None] * up - _ELEVATIONS.cos()[:, None] * ahead)
        hidden = sight.hidden(eyes[:, None], position + _BODY_POINTS).any(-1)
        first = int((~hidden).long().argmax()) if not hidden.all() else -1
        return cls(eyes[first], position + 0.8 * ahead + 0.15 * up, up, sight)

    @property
    def axes(self) -> Tensor:
        """Directions that point right and down in the image, and forward: unit vectors ``[3, 3]``."""
        forward = torch.nn.functional.normalize(self.target - self.eye, dim=0)
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, self.up), dim=0)
        return torch.stack((right, torch.linalg.cross(forward, right), forward))

    def see(self, points: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
        """Projects points into an image.

        Args:
            points: points to project, ``[..., 3]``, m.
            width: width of the image, pixels.
            height: height of the image, pixels.

        Returns:
            Pixels ``[..., 2]`` (right, down), NaN behind the near plane; and whether each point is visible, bool
            ``[...]``. Obstacles hide points, the ground does not.
        """
        points = points.double()
        offset, depth = ((points - self.eye) @ self.axes.T).split((2, 1), -1)
        depth = depth.masked_fill(depth < NEAR, math.nan)
        visible = (depth.squeeze(-1) > 0) & ~self.sight.hidden(self.eye, points)
        return torch.tensor((width / 2, height / 2)) + focal_length(height) * offset / depth, visible


def focal_length(height: int) -> float:
    """Returns the focal length (pixels) of images of the given height (pixels)."""
    return height / 2 / math.tan(math.radians(FIELD_OF_VIEW / 2))
