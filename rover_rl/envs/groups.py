"""Groups of consecutive rows whose rovers share a world."""

from __future__ import annotations

import torch
from torch import Tensor

from rover_rl.rng import episode_keys


class Groups:
    """Groups of ``agents`` consecutive rows, and the episodes of their worlds.

    The worlds of a group begin an episode when all of its rows begin one at once. As long as some of its rows go on,
    its world and the movers in it do, too.

    Args:
        agents: number of rows of a group.
        row_keys: random keys of the rows, ``[N, 1]``.

    Attributes:
        keys: random keys of the episodes of the worlds, ``[N, 1]``: those of the first row of each group.
        steps: number of steps of each world's episode, int64 ``[N, 1]``.
    """

    def __init__(self, agents: int, row_keys: Tensor) -> None:
        self._agents = agents
        self._row_keys = self.keys = first_of_group(row_keys, agents)
        self._episode = torch.zeros_like(row_keys)
        self.steps = torch.zeros_like(row_keys)

    @property
    def next_keys(self) -> Tensor:
        """Random keys of the episodes after these, ``[N, 1]``."""
        return episode_keys(self._row_keys, self._episode + 1)

    def begin(self, mask: Tensor) -> Tensor:
        """Begins episodes of the worlds of groups whose rows all begin one, and returns these rows, bool ``[N, 1]``."""
        whole = mask.reshape(-1, self._agents).all(1).repeat_interleave(self._agents)[:, None]
        self._episode = self._episode + whole
        self.keys = torch.where(whole, episode_keys(self._row_keys, self._episode), self.keys)
        self.steps = self.steps.masked_fill(whole, 0)
        return whole

    def advance(self, active: Tensor | None) -> Tensor | None:
        """Counts a step of groups with a row in ``active`` (bool ``[N, 1]``; ``None``: all), and returns their rows."""
        if active is not None:
            active = active.reshape(-1, self._agents).any(1).repeat_interleave(self._agents)[:, None]
        self.steps = self.steps + (1 if active is None else active)
        return active


def first_of_group(values: Tensor, agents: int) -> Tensor:
    """Returns the value of the first row of its group in every row, ``[N, ...]``."""
    return values if agents == 1 else values[::agents].repeat_interleave(agents, 0)
