"""Placement of rovers on the ground: 3D poses from planar poses."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from rover_rl.robots import Robot

CLEARANCE = 5e-4
"""Gap between the lowest wheel and the ground, which avoids initial penetration, m."""
RIM_ANGLE, RIM_POINTS = 1.2, 13
"""Largest angle of the tested points of a wheel's rim from straight down (rad), and their number."""


class Ground(Protocol):
    """Ground that rovers stand on: a :class:`~rover_rl.worlds.World`, or the terrain of each row of a batch."""

    def height_at(self, xy: Tensor) -> Tensor:
        """Returns the height of the ground (m) at points ``xy [N, ..., 2]``, without obstacles: ``[N, ...]``."""
        ...


class Stance(NamedTuple):
    """Where a robot touches the ground, in its base frame, float64.

    Attributes:
        hubs: x, y of the centers of the wheels, ``[W, 2]``, m.
        middle: mean of them, ``[2]``.
        rims: points on the lower half of the wheels' rims, ``[P, 3]``, m.
    """

    hubs: Tensor
    middle: Tensor
    rims: Tensor


def rest_on_ground(ground: Ground, robot: Robot, poses: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the poses of rovers that stand on the ground.

    A rover is aligned with the plane fitted to the ground below its wheels, and raised until no wheel is below the
    ground.

    Args:
        ground: ground below the rovers.
        robot: robot that defines the wheels.
        poses: planar poses ``[N, 3]``: x, y (m) and yaw (rad).

    Returns:
        Position ``[N, 3]`` (m) and rotation matrix ``[N, 3, 3]`` (columns: forward, left, up) of the base frame. Both
        are float64, so that a result does not depend on the size of the batch.
    """
    poses = poses.double()
    stance = _stance(robot, poses.device)
    height, rotation = ground_frame(ground, stance, poses)
    position = torch.cat((poses[:, :2], height[:, None]), -1)
    rims = position[:, None] + (rotation[:, None] @ stance.rims[..., None]).squeeze(-1)
    gaps = rims[..., 2] - ground.height_at(rims[..., :2])
    position[:, 2] += CLEARANCE - gaps.min(-1).values
    return position, rotation


def ground_frame(ground: Ground, stance: Stance, poses: Tensor) -> tuple[Tensor, Tensor]:
    """Fits a plane to the ground below the wheels at planar poses ``[N, 3]``.

    Returns its height at x, y, ``[N]`` (m), and the rotation of a rover on it, ``[N, 3, 3]``.
    """
    hubs, arms = stance.hubs, stance.hubs - stance.middle
    xy, yaw = poses[:, :2], poses[:, 2]
    ahead = torch.stack((yaw.cos(), yaw.sin()), -1)
    left = torch.stack((-yaw.sin(), yaw.cos()), -1)
    below = xy[:, None] + hubs[..., :1] * ahead[:, None] + hubs[..., 1:] * left[:, None]
    heights = ground.height_at(below)
    # Least squares. The wheels' x and y are uncorrelated, so the slopes are separate regressions.
    slopes = (heights[..., None] * arms).sum(1) / (arms**2).sum(0)
    up = torch.cat((-slopes[:, :1] * ahead - slopes[:, 1:] * left, torch.ones_like(slopes[:, :1])), -1)
    up = up / up.norm(dim=-1, keepdim=True)
    forward = torch.cat((ahead, slopes[:, :1]), -1)
    forward = forward - (forward * up).sum(-1, keepdim=True) * up
    forward = forward / forward.norm(dim=-1, keepdim=True)
    rotation = torch.stack((forward, torch.linalg.cross(up, forward), up), -1)
    return heights.mean(1) - (slopes * stance.middle).sum(-1), rotation


@lru_cache(maxsize=16)
def _stance(robot: Robot, device: torch.device) -> Stance:
    """Returns the stance of a robot. A copy to a GPU waits for its other work."""
    centers = torch.tensor(robot.wheels.hubs, dtype=torch.float64, device=device)
    hubs = centers[:, :2]
    return Stance(hubs, hubs.mean(0), _rims(robot, centers))


def _rims(robot: Robot, hubs: Tensor) -> Tensor:
    """Returns points on the lower half of the rims of wheels at ``hubs [W, 3]`` in the base frame: ``[P, 3]``, m."""
    angle = torch.linspace(-RIM_ANGLE, RIM_ANGLE, RIM_POINTS, dtype=torch.float64, device=hubs.device)
    across = torch.tensor(
        (-robot.wheels.width / 2, 0.0, robot.wheels.width / 2), dtype=torch.float64, device=hubs.device
    )
    arc = robot.wheels.radius * torch.stack((angle.sin(), -angle.cos()), -1)
    (x, z), y = arc.T[..., None].expand(2, -1, 3), across.expand(angle.numel(), 3)
    return (hubs[:, None] + torch.stack((x, y, z), -1).reshape(-1, 3)).reshape(-1, 3)
