"""Rows of movers without an environment, for tests of motions."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from rover_rl.rng import episode_keys, row_keys
from rover_rl.sims.movers.field import MoverField
from rover_rl.worlds import Solids, Terrain, World
from rover_rl.worlds.movers import Mover, Rovers
from rover_rl.worlds.table import WorldTable

DT = 0.05
ROVER_RADIUS = 0.3


def yard(movers: Sequence[Mover], side: float = 20.0, obstacles: Sequence[Solids] = ()) -> World:
    """Creates a flat square world with movers."""
    return World("yard", Terrain.flat((side, side)), obstacles, movers=movers)


def rovers_at(points: Tensor, velocities: Tensor | None = None) -> Rovers:
    """Returns one rover a row, at ``points [N, 2]``."""
    velocities = torch.zeros_like(points) if velocities is None else velocities
    return Rovers(points[:, None], velocities[:, None], ROVER_RADIUS)


def begun(worlds: Sequence[World], seed: int = 0, rovers: Tensor | None = None) -> MoverField:
    """Returns the movers of rows with the seeds ``seed, seed + 1, ...`` at the start of their first episodes."""
    field = MoverField(WorldTable(worlds), DT, ROVER_RADIUS)
    count = len(worlds)
    keys = episode_keys(row_keys(seed, count, torch.device("cpu")), 0)
    field.reset(torch.ones(count, 1, dtype=torch.bool), keys, torch.zeros(count, 2) if rovers is None else rovers)
    return field


def walk(
    field: MoverField, steps: int, others: Callable[[int], Rovers] | None = None, keep: str = "position"
) -> Tensor:
    """Advances movers, and returns an attribute of their courses after each step, ``[steps, N, M, ...]``."""
    rows = len(field.present)
    still = rovers_at(torch.zeros(rows, 2))
    values = []
    for step in range(steps):
        field.advance(None, still if others is None else others(step))
        values.append(getattr(field.state, keep).clone())
    return torch.stack(values)
