"""What episodes begin with: starts and goals in the free cells of each row's world, and random dynamics.

A policy that is trained on many variations of the dynamics is less sensitive to differences between simulators and a
real robot (J. Tobin et al., "Domain randomization for transferring deep neural networks from simulation to the real
world", IROS 2017).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import fields

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.envs.chosen_rows import EVERY_ROW, ChosenRows
from rover_rl.envs.config import Randomization
from rover_rl.rng import random_bits, to_index, to_unit
from rover_rl.robots import Robot
from rover_rl.sims.free_space import free_space
from rover_rl.sims.free_space.space import HEADINGS
from rover_rl.sims.rover_state import Dynamics
from rover_rl.worlds import World
from rover_rl.worlds.table import SlotTable, WorldTable, in_threads

_START, _GOAL, _DYNAMICS = 0, 1, 2
"""Streams of random numbers."""
_CANDIDATES = 8
"""Number of goals drawn at once. The first that is far enough is used, so that no loop is needed."""


class Placement:
    """Draws start poses and goals for a batch whose rows may be in different worlds.

    ``robot`` is the one that needs the free space, or a function that returns the free space of a world. Goals are at
    least ``min_goal_distance`` (m) away from the rover. ``bounds`` are those of each row's world, ``[N, 4]``, m: lower
    x and y (``bounds_low``), and upper x and y (``bounds_high``).
    """

    def __init__(self, worlds: WorldTable, robot: Robot | Callable[[World], Robot], min_goal_distance: float) -> None:
        self._robot_in = robot if callable(robot) else lambda _: robot
        self._min_goal_distance, device = min_goal_distance, worlds.slots.device
        self._worlds, self._entered = worlds, worlds.follow()
        self._start_cells = SlotTable((2,), torch.float32, device)
        self._headings = SlotTable((), torch.int64, device)
        self._goal_cells = SlotTable((2,), torch.float32, device)
        # The outermost goal cells in 16 directions, for positions from which no candidate is far enough.
        self._extremes = SlotTable((2,), torch.float32, device)
        self._bounds = SlotTable((2,), torch.float32, device)
        self._cells = SlotTable((), torch.float32, device)
        self.enter_worlds()

    def enter_worlds(self) -> None:
        """Moves rows to their worlds in the table, after these have changed."""
        worlds = self._entered()
        found = in_threads(lambda world: free_space(world, self._robot_in(world)), worlds.values())
        spaces = dict(zip(worlds, found, strict=True))
        self._start_cells.update({slot: space.spawn_cells for slot, space in spaces.items()})
        self._headings.update({slot: space.spawn_headings for slot, space in spaces.items()})
        self._goal_cells.update({slot: space.goal_cells for slot, space in spaces.items()})
        self._extremes.update({slot: space.goal_extremes for slot, space in spaces.items()})
        self._cells.update({slot: torch.tensor([space.cell]) for slot, space in spaces.items()})
        self._bounds.update({slot: torch.tensor(world.bounds).T for slot, world in worlds.items()})
        self.bounds_low, self.bounds_high = corners = self._bounds.values[self._worlds.slots].unbind(1)
        self.bounds = torch.cat(corners, -1)

    def draw_start(self, keys: Tensor, rows: ChosenRows = EVERY_ROW, taken: Tensor | None = None) -> Tensor:
        """Draws start poses ``[N, 3]`` (x, y in m, yaw in rad) from the keys of the episodes ``[N, 1]``.

        Those of other rows may be anything. ``taken`` are positions of their rovers, ``[N, 2]``, m: rovers of a group
        share worlds.
        """
        return rows.into(None, self._starts(rows.of(keys), 0, rows.of(self._worlds.slots)))

    def _starts(self, keys: Tensor, draw: Tensor | int, slot: Tensor) -> Tensor:
        bits = random_bits(keys, _START, draw, 5)
        cell = to_index(bits[:, 0], self._start_cells.lengths[slot])
        jitter = to_unit(bits[:, 1:3]) - 0.5
        heading = _draw_bin(bits[:, 3], self._headings.values[slot, cell])[:, None] + to_unit(bits[:, 4:])
        yaw = heading * (2 * math.pi / HEADINGS) - math.pi
        return torch.cat((self._start_cells.values[slot, cell] + jitter * self._cells.values[slot], yaw), -1)

    def draw_goal(
        self,
        keys: Tensor,
        number: Tensor | int,
        position: Tensor,
        rows: ChosenRows = EVERY_ROW,
        goals: Tensor | None = None,
    ) -> Tensor:
        """Draws goals ``[N, 2]`` (m), uniformly from the free goal cells that are far enough from the position.

        ``number`` are the goals set in the episode so far, ``[N, 1]`` or one for all. Other rows keep their ``goals``.
        """
        candidates, far = self._goals(keys, number, position, rows, _CANDIDATES)
        first = far.to(torch.uint8).argmax(1, keepdim=True).expand(-1, 1, 2)
        return rows.into(goals, candidates.gather(1, first).squeeze(1))

    def _goals(
        self, keys: Tensor, number: Tensor | int, position: Tensor, rows: ChosenRows, count: int
    ) -> tuple[Tensor, Tensor]:
        """Returns candidates of the rows, ``[M, K, 2]``, and which are far enough ``[M, K, 1]``."""
        slot, number = rows.of(self._worlds.slots), number if isinstance(number, int) else rows.of(number)
        bits = random_bits(rows.of(keys), _GOAL, number, count)
        # The upper 32 bits select the cell. The lower two times 16 bits are the position in the cell.
        jitter = torch.stack((bits & 0xFFFF, (bits >> 16) & 0xFFFF), -1).float() * 2.0**-16 - 0.5
        cell = to_index(bits, self._goal_cells.lengths[slot][:, None])
        drawn = self._goal_cells.values[slot[:, None], cell] + jitter * self._cells.values[slot][:, None]
        candidates = torch.cat((drawn, self._extremes.values[slot]), 1)
        offset = candidates - rows.of(position)[:, None]
        return candidates, (offset * offset).sum(-1, keepdim=True) >= self._min_goal_distance**2


def checked_place(
    key: str, value: Tensor | None, tensordict: TensorDictBase | None, shape: Sequence[int], device: torch.device
) -> Tensor | None:
    """Returns a ``"start"`` or ``"goal"`` ``[N, k]`` given to a reset as ``value`` or in its tensordict, or ``None``.

    Raises ``ValueError`` if the shape is not ``shape``, ``[*batch_size, k]``, or values are not finite.
    """
    if value is None and tensordict is not None:
        value = tensordict.get(key, None)
    if value is None:
        return None
    value = torch.as_tensor(value, dtype=torch.float32, device=device)
    if value.shape != tuple(shape) or not torch.isfinite(value).all():
        raise ValueError(f"{key} must be finite numbers of shape {tuple(shape)}, got shape {tuple(value.shape)}")
    return value.reshape(-1, shape[-1])


def draw_dynamics(randomization: Randomization, keys: Tensor) -> Dynamics:
    """Draws the scale factors of each row's dynamics, float32 ``[N]`` each, from the keys of the episodes."""
    names = [item.name for item in fields(Dynamics)]
    fractions = to_unit(random_bits(keys, _DYNAMICS, 0, len(names))).unbind(-1)
    ranges = {name: getattr(randomization, name) for name in names}
    pairs = zip(fractions, ranges.items(), strict=True)
    return Dynamics(**{name: low + fraction * (high - low) for fraction, (name, (low, high)) in pairs})


def _draw_bin(bits: Tensor, allowed: Tensor) -> Tensor:
    """Draws one of the heading bins that are set in ``allowed [N]`` (bit masks) for each row: int64 ``[N]``."""
    # A sum along the rows of memory would be slow on a GPU.
    rank = ((allowed >> torch.arange(HEADINGS, device=allowed.device)[:, None]) & 1).cumsum(0)
    number = to_index(bits, rank[-1])
    return (rank > number).to(torch.uint8).argmax(0)
