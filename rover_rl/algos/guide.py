"""Guide: knows the map, and from everywhere the shortest way to the goal. For training only.

Example:
    >>> env = make_env(world_n="maze", num_envs=2, seed=0)
    >>> guides = Guides(env.worlds, env.robot)
    >>> guides.action(env.reset()).shape
    torch.Size([2, 2])
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.algos.baselines import drive
from rover_rl.algos.routes import distance_fields
from rover_rl.sims.robots import Robot
from rover_rl.sims.rotations import wrap_angle
from rover_rl.sims.worlds import World, free_space

ANCHORS = 0.5
"""Metres between the places that stand for the goals around them."""
CAUTION = 4.0
"""The way keeps clear of walls: a metre right beside one counts as five."""
DIRECTIONS = 32
"""To choose from."""
LOOK_AHEAD = (0.3, 0.6)
"""Metres at which they are looked at."""
BLOCKED = 50.0
"""Metres that the way counts as longer through what is not passable."""
NEAR = 0.8
"""Metres to the goal within which it is driven at straight."""


class Guide:
    """Tells from the pose how far it is to the goal along the shortest free way, and how to follow that.

    A policy without map and pose can learn from it: what it does (``imitation`` in
    :class:`~rover_rl.algos.config.PPOConfig`), or what it gains (:class:`~rover_rl.algos.path_reward.PathReward`).
    Observations need ``pose``, ``imu``, ``target`` and, to act, ``lidar``.

    Args:
        world: where rovers drive.
        robot: that has to fit.
        device: where observations are; ``None``: the CPU.
    """

    def __init__(self, world: World, robot: Robot, device: torch.device | str | None = None) -> None:
        space = free_space(world, robot)
        blocks = torch.unique((space.goal_cells / ANCHORS).round(), dim=0) * ANCHORS
        anchors = space.goal_cells[torch.cdist(blocks, space.goal_cells).argmin(-1)].float()
        self._fields = distance_fields(world, robot, anchors, CAUTION).to(device)
        self._anchors = anchors.to(device)
        self._space = space.to(device)
        self._origin = torch.tensor(space.origin, device=device)
        angles = torch.arange(DIRECTIONS, device=device) * (2 * math.pi / DIRECTIONS)
        self._angles, self._directions = angles, torch.stack((angles.cos(), angles.sin()), -1)

    def path_length(self, observation: TensorDictBase) -> Tensor:
        """Metres left on the way, those along walls counted up to five times, float32 ``[N, 1]``.

        It is the way to the nearest of places 0.5 m apart that stand for the goals around them.
        """
        return self._length(self._anchor(observation), observation["pose"][:, :2])[:, None]

    def action(self, observation: TensorDictBase) -> Tensor:
        """Follows the way, ``[N, 2]``: forward speed (m/s) and heading offset (rad)."""
        anchor, position = self._anchor(observation)[:, None], observation["pose"][:, None, :2]
        length = position.new_zeros(len(anchor), DIRECTIONS)
        for distance in LOOK_AHEAD:
            there = position + distance * self._directions
            length += self._length(anchor, there) + BLOCKED * ~self._space.contains(there)
        ahead = wrap_angle(self._angles[length.argmin(-1, keepdim=True)] - observation["imu"][:, 2:])
        distance, bearing = observation["target"].split(1, -1)
        return drive(torch.where(distance < NEAR, bearing, ahead), observation["lidar"])

    def _anchor(self, observation: TensorDictBase) -> Tensor:
        """Number of the place that stands for the goal, ``[N]``."""
        distance, bearing = observation["target"].split(1, -1)
        direction = bearing + observation["imu"][:, 2:]
        goal = observation["pose"][:, :2] + distance * torch.cat((direction.cos(), direction.sin()), -1)
        return torch.cdist(goal, self._anchors).argmin(-1)

    def _length(self, anchor: Tensor, position: Tensor) -> Tensor:
        """Of the way to an anchor from positions ``[..., 2]``."""
        rows, columns = self._fields.shape[1:]
        column, row = ((position - self._origin) / self._space.cell).round().long().unbind(-1)
        return self._fields[anchor, row.clamp(0, rows - 1), column.clamp(0, columns - 1)]


class Guides:
    """A :class:`Guide` for each world of a batch.

    Args:
        worlds: the world of each row.
        robot: that has to fit.
        device: where observations are; ``None``: the CPU.
    """

    def __init__(self, worlds: Sequence[World], robot: Robot, device: torch.device | str | None = None) -> None:
        places = dict.fromkeys(worlds)
        self._guides = [Guide(world, robot, device) for world in places]
        rows = [torch.tensor([row for row, world in enumerate(worlds) if world is place]) for place in places]
        self._rows = [some.to(device) for some in rows]
        self._order = torch.cat(rows).argsort().to(device)

    def path_length(self, observation: TensorDictBase) -> Tensor:
        """As :meth:`Guide.path_length`, for observations ``[N, ...]``: float32 ``[N, ..., 1]``."""
        return self._ask(Guide.path_length, observation)

    def action(self, observation: TensorDictBase) -> Tensor:
        """As :meth:`Guide.action`, for observations ``[N, ...]``: ``[N, ..., 2]``."""
        return self._ask(Guide.action, observation)

    def _ask(self, question: Callable[[Guide, TensorDictBase], Tensor], observation: TensorDictBase) -> Tensor:
        told = []
        for guide, rows in zip(self._guides, self._rows, strict=True):
            some = observation[rows]
            told.append(question(guide, some.reshape(-1)).unflatten(0, some.batch_size))
        return torch.cat(told)[self._order]
