"""Random start poses and goals, drawn for each row from the free cells of its world."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from rover_rl.envs.rng import random_bits, to_index, to_unit
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds import World, free_space, get_world
from rover_rl.sims.worlds.free_space import HEADINGS

_START, _GOAL = 0, 1
"""Streams of random numbers."""

_CANDIDATES = 8
"""Number of goals drawn at once. The first that is far enough is used, so that no loop is needed."""


class Placement:
    """Draws start poses and goals for a batch whose rows may be in different worlds.

    Args:
        worlds: world of each row.
        robot: robot that determines the free space.
        min_goal_distance: minimum distance from the rover to a new goal, m.
        device: device of the draws.

    Attributes:
        bounds_low, bounds_high: lower and upper corners of the bounds of each row's world, ``[N, 2]``, m.
    """

    def __init__(self, worlds: Sequence[World], robot: Robot, min_goal_distance: float, device: torch.device) -> None:
        distinct = list(dict.fromkeys(worlds))
        spaces = [free_space(world, robot) for world in distinct]
        world_index = torch.tensor([distinct.index(world) for world in worlds])
        bounds = torch.tensor([world.bounds for world in worlds], dtype=torch.float32, device=device)
        self.bounds_low, self.bounds_high = bounds[..., 0], bounds[..., 1]
        self._cell = torch.tensor([[space.cell] for space in spaces])[world_index].to(device)
        self._min_goal_distance = min_goal_distance
        self._starts = _CellTable([space.spawn_cells for space in spaces], world_index, device)
        self._headings = torch.cat([space.spawn_headings for space in spaces]).to(device)
        self._heading_counts = torch.cat([space.spawn_heading_counts for space in spaces]).to(device)
        self._goals = _CellTable([space.goal_cells for space in spaces], world_index, device)
        # The outermost goal cells in 16 directions, for positions from which no candidate is far enough.
        self._fallback_goals = torch.stack([space.goal_extremes.float() for space in spaces])[world_index].to(device)

    def draw_start(self, keys: Tensor) -> Tensor:
        """Draws start poses ``[N, 3]`` (x, y in m, yaw in rad) from the keys of the episodes ``[N, 1]``."""
        bits = random_bits(keys, _START, 0, 5)
        cell = self._starts.index(bits[:, :1]).squeeze(-1)
        jitter = to_unit(bits[:, 1:3]) - 0.5
        slot = to_index(bits[:, 3], self._heading_counts[cell])
        heading = self._headings[cell, slot][:, None] + to_unit(bits[:, 4:])
        yaw = heading * (2 * math.pi / HEADINGS) - math.pi
        return torch.cat((self._starts.points[cell] + jitter * self._cell, yaw), -1)

    def draw_goal(self, keys: Tensor, number: Tensor, position: Tensor) -> Tensor:
        """Draws goals ``[N, 2]`` (m), uniformly from the free goal cells at least ``min_goal_distance`` away.

        Args:
            keys: random keys of the episodes, ``[N, 1]``.
            number: number of goals set in the episode so far, ``[N, 1]``.
            position: position of the rover, ``[N, 2]``, m.
        """
        bits = random_bits(keys, _GOAL, number, _CANDIDATES)
        # The upper 32 bits select the cell. The lower two times 16 bits are the position in the cell.
        jitter = torch.stack((bits & 0xFFFF, (bits >> 16) & 0xFFFF), -1).float() * 2.0**-16 - 0.5
        drawn = self._goals.points[self._goals.index(bits)] + jitter * self._cell[:, None]
        candidates = torch.cat((drawn, self._fallback_goals), 1)
        offset = candidates - position[:, None]
        far = (offset * offset).sum(-1, keepdim=True) >= self._min_goal_distance**2
        first = far.to(torch.uint8).argmax(1, keepdim=True).expand(-1, 1, 2)
        return candidates.gather(1, first).squeeze(1)


class _CellTable:
    """Cell centers of several worlds in one tensor, with the range that belongs to each row.

    Args:
        points: cell centers of each world, ``[cells, 2]``, m.
        world_index: index of each row's world, ``[N]``.
        device: device of the table.
    """

    def __init__(self, points: list[Tensor], world_index: Tensor, device: torch.device) -> None:
        counts = torch.tensor([len(p) for p in points])
        self.points = torch.cat(points).float().to(device)
        self._count = counts[world_index][:, None].to(device)
        self._offset = (counts.cumsum(0) - counts)[world_index][:, None].to(device)

    def index(self, bits: Tensor) -> Tensor:
        """Returns random indices into ``points`` within each row's world, from ``bits [N, k]``."""
        return self._offset + to_index(bits, self._count)


def assign_rows(world_n: str | World | Sequence[str | World], num_envs: int) -> list[World]:
    """Returns the world of each row. Several worlds are assigned to equal blocks of rows."""
    names = [world_n] if isinstance(world_n, (str, World)) else list(world_n)
    if not 1 <= len(names) <= num_envs:
        raise ValueError(f"world_n must give between 1 and num_envs={num_envs} worlds, got {len(names)}")
    worlds = [get_world(name) for name in names]
    return [worlds[row * len(worlds) // num_envs] for row in range(num_envs)]
