"""Cameras that follow a rover, and the projection of points into their images."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rover_rl.sims.base import View
from rover_rl.sims.rotations import quaternion_to_euler
from rover_rl.sims.worlds import World

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
_VISIBLE_FRACTION = 0.98
"""Fraction of the line of sight that must be free, less than 1 because a point may lie on an obstacle."""


@dataclass(frozen=True)
class Camera:
    """Camera in a world. Vectors are ``[3]``, float64.

    Attributes:
        eye: position of the camera, m.
        target: point at the center of the image, m.
        up: direction that points up in the image.
        world: world whose obstacles hide points.
    """

    eye: Tensor
    target: Tensor
    up: Tensor
    world: World

    @classmethod
    def on(cls, position: Tensor, orientation: Tensor, world: World, view: View) -> Camera:
        """Creates the camera behind (``"chase"``) or above (``"top"``) a rover.

        The chase camera moves up when an obstacle hides the rover.

        Args:
            position: position of the rover, ``[3]``, m.
            orientation: orientation of the rover, unit quaternion (x, y, z, w), ``[4]``.
            world: world of the rover.
            view: ``"chase"`` or ``"top"``.

        Raises:
            ValueError: if the view is unknown.
        """
        position = position.double()
        up = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
        if view == "top":
            north = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
            return cls(position + _TOP_HEIGHT * up, position, north, world)
        if view != "chase":
            raise ValueError(f"unknown view {view!r}; use 'chase' or 'top'")
        yaw = quaternion_to_euler(orientation)[2].item()
        ahead = torch.tensor((math.cos(yaw), math.sin(yaw), 0.0), dtype=torch.float64)
        eyes = position + _CHASE_DISTANCE * (_ELEVATIONS.sin()[:, None] * up - _ELEVATIONS.cos()[:, None] * ahead)
        hidden = _hidden(world, eyes[:, None], position + _BODY_POINTS).any(-1)
        first = int((~hidden).long().argmax()) if not hidden.all() else -1
        return cls(eyes[first], position + 0.8 * ahead + 0.15 * up, up, world)

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
        visible = (depth.squeeze(-1) > 0) & ~_hidden(self.world, self.eye, points)
        return torch.tensor((width / 2, height / 2)) + focal_length(height) * offset / depth, visible


def focal_length(height: int) -> float:
    """Returns the focal length (pixels) of images of the given height (pixels)."""
    return height / 2 / math.tan(math.radians(FIELD_OF_VIEW / 2))


def _hidden(world: World, eye: Tensor, points: Tensor) -> Tensor:
    """Returns whether an obstacle lies between ``eye [..., 3]`` and ``points [..., 3]``: bool ``[...]``."""
    eye, sight = torch.broadcast_tensors(eye, points - eye)
    hidden = torch.zeros(sight.shape[:-1], dtype=torch.bool)
    for obstacle in world.obstacles:
        normals, offsets = obstacle.planes.to(sight).split((3, 1), -1)
        # Adding 0 turns -0 into 0: for a line parallel to a face, the quotient below must be inf on the inner side of
        # the face and -inf on the outer side.
        approach = sight @ normals.T + 0.0
        # Fractions of the line of sight at which it crosses the plane of each face, inward or outward.
        crossing = -(eye @ normals.T + offsets.squeeze(-1)) / approach
        enter = crossing.masked_fill(approach >= 0, -math.inf).amax(-1)
        leave = crossing.masked_fill(approach < 0, math.inf).amin(-1)
        hidden |= enter.clamp(min=0) < leave.clamp(max=_VISIBLE_FRACTION)
    return hidden
