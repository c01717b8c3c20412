"""Where pictures of a rover are taken from, and what is seen from there."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rover_rl.sims.base import View
from rover_rl.sims.rotations import quaternion_to_euler
from rover_rl.sims.worlds import World

FIELD_OF_VIEW = 60.0
"""From the bottom to the top of a picture, degrees."""
NEAR = 0.05
"""What is nearer than this counts as behind the camera, m."""
_ABOVE = 12.0
"""Height of the top view above the rover, m."""
_DISTANCE = 2.55
"""Of the chase view from the rover, m."""
_ELEVATIONS = torch.linspace(math.radians(30.5), math.radians(85), 20, dtype=torch.float64)
"""Of the chase view: it takes the first from which an obstacle does not hide the rover."""
_BODY = torch.tensor([(x, y, 0.1) for x in (-0.25, 0.25) for y in (-0.25, 0.25)], dtype=torch.float64)
"""Where the rover has to be seen, m from its origin."""
_REACHED = 0.98
"""Share of the way to a point at which it is reached: it may itself lie on an obstacle."""


@dataclass(frozen=True)
class Camera:
    """An eye that looks at a target: all ``[3]``, float64, m.

    Attributes:
        eye: where it is.
        target: what it looks at, the middle of the picture.
        up: direction that is up in the picture.
        world: what it stands in.
    """

    eye: Tensor
    target: Tensor
    up: Tensor
    world: World

    @classmethod
    def on(cls, position: Tensor, orientation: Tensor, world: World, view: View) -> Camera:
        """The camera behind (``"chase"``) or high above (``"top"``) a rover, which it always sees.

        Args:
            position: of the rover, ``[3]``, m.
            orientation: of the rover, a unit quaternion ``[4]``.
            world: around it.
            view: which of the two.

        Raises:
            ValueError: for another view.
        """
        position = position.double()
        up = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
        if view == "top":
            north = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
            return cls(position + _ABOVE * up, position, north, world)
        if view != "chase":
            raise ValueError(f"unknown view {view!r}; use 'chase' or 'top'")
        yaw = quaternion_to_euler(orientation)[2].item()
        ahead = torch.tensor((math.cos(yaw), math.sin(yaw), 0.0), dtype=torch.float64)
        eyes = position + _DISTANCE * (_ELEVATIONS.sin()[:, None] * up - _ELEVATIONS.cos()[:, None] * ahead)
        hidden = _hidden(world, eyes[:, None], position + _BODY).any(-1)
        first = int((~hidden).long().argmax()) if not hidden.all() else -1
        return cls(eyes[first], position + 0.8 * ahead + 0.15 * up, up, world)

    def see(self, points: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
        """Where in a picture points are.

        Args:
            points: ``[..., 3]``, m.
            width, height: of the picture, pixels.

        Returns:
            Pixels ``[..., 2]`` (right, down), nan behind the camera, and whether the points are seen: bool ``[...]``.
            What an obstacle hides is not seen; the ground hides nothing here.
        """
        points = points.double()
        forward = torch.nn.functional.normalize(self.target - self.eye, dim=0)
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, self.up), dim=0)
        axes = torch.stack((right, torch.linalg.cross(forward, right), forward))
        beside, depth = ((points - self.eye) @ axes.T).split((2, 1), -1)
        depth = depth.masked_fill(depth < NEAR, math.nan)
        focal = height / 2 / math.tan(math.radians(FIELD_OF_VIEW / 2))
        seen = (depth.squeeze(-1) > 0) & ~_hidden(self.world, self.eye, points)
        return torch.tensor((width / 2, height / 2)) + focal * beside / depth, seen


def _hidden(world: World, eye: Tensor, points: Tensor) -> Tensor:
    """Whether an obstacle is on the way from ``eye [..., 3]`` to ``points [..., 3]``: bool ``[...]``."""
    eye, way = torch.broadcast_tensors(eye, points - eye)
    hidden = torch.zeros(way.shape[:-1], dtype=torch.bool)
    for obstacle in world.obstacles:
        normals, offsets = obstacle.planes.to(way).split((3, 1), -1)
        # Never -0: along a face the quotient below is to be inf inside of it, and -inf outside.
        approach = way @ normals.T + 0.0
        # Shares of the way at which it crosses each face, inwards or outwards.
        crossing = -(eye @ normals.T + offsets.squeeze(-1)) / approach
        enter = crossing.masked_fill(approach >= 0, -math.inf).amax(-1)
        leave = crossing.masked_fill(approach < 0, math.inf).amin(-1)
        hidden |= enter.clamp(min=0) < leave.clamp(max=_REACHED)
    return hidden
