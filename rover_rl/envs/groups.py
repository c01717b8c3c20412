"""Groups of consecutive rows whose rovers share a world: their episodes, starts and goals."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from rover_rl.envs.apart_kernels import choose_apart
from rover_rl.envs.chosen_rows import EVERY_ROW, ChosenRows
from rover_rl.envs.placement import Placement
from rover_rl.envs.rows import Episodes, first_of_group
from rover_rl.native.warp import stream_of, wp
from rover_rl.rng import episode_keys
from rover_rl.robots import Robot
from rover_rl.sims.free_space import free_space
from rover_rl.worlds.table import WorldTable
from rover_rl.worlds.world import World

GAP = 1.0
"""Distance between the discs of the rovers of a group at the start, and between their discs at their goals, m."""
_CANDIDATES = 32
"""Number of places drawn at once. The first that is far enough from the others is used."""


class GroupEpisodes(Episodes):
    """Episodes of rows in groups of ``agents``.

    The worlds of a group begin an episode when all of its rows begin one at once. As long as some of its rows go on,
    its world and the movers in it do, too. The keys of the worlds are those of the first row of each group.
    """

    world_steps: Tensor

    def __init__(self, seed: int, num_envs: int, device: torch.device, agents: int) -> None:
        super().__init__(seed, num_envs, device)
        self._agents = agents
        self._first = self.world_keys = first_of_group(self._rows, agents)
        self._world_number = self.world_steps = torch.zeros_like(self._rows)

    def begin(self, rows: ChosenRows) -> ChosenRows:
        world_keys = self.world_keys
        super().begin(rows)
        whole = ChosenRows(self._in_group(rows.mask.reshape(-1, self._agents).all(1)))
        numbers = whole.of(self._world_number) + 1
        self._world_number = whole.into(self._world_number, numbers)
        self.world_keys = whole.into(world_keys, episode_keys(whole.of(self._first), numbers))
        self.world_steps = self.world_steps.masked_fill(whole.mask, 0)
        return whole

    def next_world_keys(self, rows: ChosenRows) -> Tensor:
        return episode_keys(rows.of(self._first), rows.of(self._world_number) + 1)

    def advance(self, active: Tensor | None) -> Tensor | None:
        if active is not None:
            active = self._in_group(active.reshape(-1, self._agents).any(1))
        self.world_steps = self.world_steps + (1 if active is None else active)
        return active

    def _in_group(self, groups: Tensor) -> Tensor:
        return groups.repeat_interleave(self._agents)[:, None]


class GroupPlacement(Placement):
    """Draws start poses and goals for groups of rovers, which share worlds.

    The ``agents`` rovers of a group start with at least :data:`GAP` between their discs, and so do their goals lie. A
    rover takes the first of 32 places that is free of the others; if none is, the one that is farthest from them.
    """

    def __init__(self, worlds: WorldTable, robot: Robot, min_goal_distance: float, agents: int) -> None:
        self._agents, self._spacing, self._crowded = agents, GAP + 2 * robot.radius, ""
        self._unchecked = worlds.follow()
        super().__init__(worlds, robot, min_goal_distance)

    def draw_start(self, keys: Tensor, rows: ChosenRows = EVERY_ROW, taken: Tensor | None = None) -> Tensor:
        if self._crowded:
            raise ValueError(self._crowded)
        slot = rows.of(self._worlds.slots)
        draw = torch.arange(_CANDIDATES, device=keys.device).repeat(len(slot))[:, None]
        several = rows.of(keys).repeat_interleave(_CANDIDATES, 0), draw, slot.repeat_interleave(_CANDIDATES)
        poses = self._starts(*several).reshape(len(slot), _CANDIDATES, 3)
        allowed = torch.ones_like(poses[..., 0], dtype=torch.bool)
        return rows.into(None, self._apart(poses, allowed, rows, taken, len(keys)))

    def draw_goal(
        self,
        keys: Tensor,
        number: Tensor | int,
        position: Tensor,
        rows: ChosenRows = EVERY_ROW,
        goals: Tensor | None = None,
    ) -> Tensor:
        candidates, far = self._goals(keys, number, position, rows, _CANDIDATES)
        return rows.into(goals, self._apart(candidates, far.squeeze(-1), rows, goals, len(keys)))

    def _apart(self, candidates: Tensor, allowed: Tensor, rows: ChosenRows, taken: Tensor | None, count: int) -> Tensor:
        device = candidates.device
        drawn = torch.ones(count, dtype=torch.bool, device=device) if rows.mask is None else rows.mask.squeeze(-1)
        number = torch.arange(count, device=device) if len(candidates) == count else drawn.cumsum(0) - 1
        numbers = torch.where(drawn, number, -1).int()
        places = torch.zeros(count, 2, device=device) if taken is None else taken.contiguous().clone()
        chosen = torch.zeros(count, dtype=torch.int32, device=device)
        with wp.ScopedStream(stream_of(device)):
            drawn_from = wp.from_torch(candidates[..., :2].contiguous(), dtype=wp.vec2)
            given = [drawn_from, wp.from_torch(allowed.contiguous()), wp.from_torch(numbers), self._agents]
            results = [self._spacing, wp.from_torch(places, dtype=wp.vec2), wp.from_torch(chosen)]
            wp.launch(choose_apart, count // self._agents, given + results, device=wp.device_from_torch(device))
        index = rows.of(chosen).long()[:, None, None].expand(-1, 1, candidates.shape[-1])
        return candidates.gather(1, index).squeeze(1)

    def enter_worlds(self) -> None:
        super().enter_worlds()
        for world in self._unchecked().values():
            if (room := _room(world, self._robot_in(world), self._spacing, self._agents)) < self._agents:
                self._crowded = (
                    f"the start area of world {world.name!r} has room for {room} rovers {GAP:g} m apart, not for "
                    f"agents={self._agents}"
                )


@lru_cache(maxsize=1024)
def _room(world: World, robot: Robot, spacing: float, most: int) -> int:
    """Returns how many of ``most`` points in the start area can be ``spacing`` (m) apart, each the farthest of all."""
    cells = free_space(world, robot).spawn_cells
    nearest = (cells - cells[0]).norm(dim=-1)
    for found in range(1, most):
        distance, farthest = nearest.max(0)
        if distance < spacing:
            return found
        nearest = torch.minimum(nearest, (cells - cells[farthest]).norm(dim=-1))
    return most
