"""Where episodes start and goals lie: drawn per row from the free cells of the row's world."""

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
"""Streams of random draws."""

_CANDIDATES = 8
"""Goals drawn at once: the first that is far enough is taken, so that nothing is drawn again."""


class Placement:
    """Draws starts and goals for a batch whose rows may be in different worlds.

    Args:
        worlds: the world of each row.
        robot: the rover that has to fit.
        min_goal_distance: a goal is at least so far from the rover, m.
        device: where to draw.

    Attributes:
        bounds_low, bounds_high: corners of each row's bounds, ``[N, 2]``, m.
    """

    def __init__(self, worlds: Sequence[World], robot: Robot, min_goal_distance: float, device: torch.device) -> None:
        kinds = list(dict.fromkeys(worlds))
        spaces = [free_space(world, robot) for world in kinds]
        kind = torch.tensor([kinds.index(world) for world in worlds])
        areas = torch.tensor([world.bounds for world in worlds], dtype=torch.float32, device=device)
        self.bounds_low, self.bounds_high = areas[..., 0], areas[..., 1]
        self._cell = torch.tensor([[space.cell] for space in spaces])[kind].to(device)
        self._min_goal_distance = min_goal_distance
        self._starts = _Table([space.spawn_cells for space in spaces], kind, device)
        self._headings = torch.cat([space.spawn_headings for space in spaces]).to(device)
        self._heading_counts = torch.cat([space.spawn_heading_counts for space in spaces]).to(device)
        self._goals = _Table([space.goal_cells for space in spaces], kind, device)
        self._last_resort = torch.stack([space.goal_extremes.float() for space in spaces])[kind].to(device)

    def draw_start(self, keys: Tensor) -> Tensor:
        """Poses ``[N, 3]`` (x, y in m, yaw in rad) at which an episode may start, from episode keys ``[N, 1]``."""
        bits = random_bits(keys, _START, 0, 5)
        cell = self._starts.index(bits[:, :1]).squeeze(-1)
        jitter = to_unit(bits[:, 1:3]) - 0.5
        slot = to_index(bits[:, 3], self._heading_counts[cell])
        heading = self._headings[cell, slot][:, None] + to_unit(bits[:, 4:])
        yaw = heading * (2 * math.pi / HEADINGS) - math.pi
        return torch.cat((self._starts.points[cell] + jitter * self._cell, yaw), -1)

    def draw_goal(self, keys: Tensor, number: Tensor, position: Tensor) -> Tensor:
        """Goals ``[N, 2]`` (m), uniform over the free goal cells at least ``min_goal_distance`` away.

        Args:
            keys: of the episodes, ``[N, 1]``.
            number: how many goals the episode has had, ``[N, 1]``.
            position: where the rover is, ``[N, 2]``, m.
        """
        bits = random_bits(keys, _GOAL, number, _CANDIDATES)
        # The index takes the upper half of the bits; a quarter each is left for the place within the cell.
        jitter = torch.stack((bits & 0xFFFF, (bits >> 16) & 0xFFFF), -1).float() * 2.0**-16 - 0.5
        drawn = self._goals.points[self._goals.index(bits)] + jitter * self._cell[:, None]
        candidates = torch.cat((drawn, self._last_resort), 1)
        away = candidates - position[:, None]
        far = (away * away).sum(-1, keepdim=True) >= self._min_goal_distance**2
        first = far.to(torch.uint8).argmax(1, keepdim=True).expand(-1, 1, 2)
        return candidates.gather(1, first).squeeze(1)


class _Table:
    """Points of several worlds in one tensor, and which of them belong to each row."""

    def __init__(self, points: list[Tensor], kind: Tensor, device: torch.device) -> None:
        counts = torch.tensor([len(p) for p in points])
        self.points = torch.cat(points).float().to(device)
        self._count = counts[kind][:, None].to(device)
        self._offset = (counts.cumsum(0) - counts)[kind][:, None].to(device)

    def index(self, bits: Tensor) -> Tensor:
        """Random indices into ``points`` of each row's own world, as many as ``bits [N, k]``."""
        return self._offset + to_index(bits, self._count)


def assign_rows(world_n: str | World | Sequence[str | World], num_envs: int) -> list[World]:
    """The world of each row: the given ones in equal blocks."""
    names = [world_n] if isinstance(world_n, (str, World)) else list(world_n)
    if not 1 <= len(names) <= num_envs:
        raise ValueError(f"world_n must give between 1 and num_envs={num_envs} worlds, got {len(names)}")
    worlds = [get_world(name) for name in names]
    return [worlds[row * len(worlds) // num_envs] for row in range(num_envs)]
