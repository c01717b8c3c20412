"""Actions on a grid of speeds and turns, and a distribution over them.

A normal distribution has one center: between two ways around what comes, it points into it. On a grid, each action has
a probability of its own (Y. Tang, S. Agrawal, "Discretizing continuous action space for on-policy optimization", AAAI
2020).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

SPEEDS, TURNS = 5, 11  # numbers of speeds, from the lowest to the highest, and of turns, from right to left
ACTIONS = SPEEDS * TURNS
TURN = 0.62
"""Largest turn of the grid, as a share of the bounds: the heading PID of a rover turns no faster for a larger one."""
LABELS = "labels"
"""Entry of a batch: weights with which the actions of the grid are imitated, ``[..., ACTIONS]``."""


def grid_actions(low: Tensor, high: Tensor) -> Tensor:
    """Returns the actions of grids within bounds ``[..., 2]``: speed by speed, all turns, ``[..., ACTIONS, 2]``."""
    return _within(_shares(low.device), low[..., None, :], high[..., None, :])


def actions_at(index: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Returns actions of grids by their indices, int64 ``[...]``: ``[..., 2]``."""
    return _within(_shares(low.device)[index], low, high)


def nearest_index(action: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Returns the indices in grids of the nearest actions, int64 ``[...]``, of actions ``[..., 2]``."""
    away = (action[..., None, :] - grid_actions(low, high)) / (high - low)[..., None, :]
    return away.square().sum(-1).argmin(-1)


def _shares(device: torch.device) -> Tensor:
    speeds, turns = torch.linspace(0, 1, SPEEDS, device=device), torch.linspace(-TURN, TURN, TURNS, device=device)
    return torch.cartesian_prod(speeds, turns)


def _within(shares: Tensor, low: Tensor, high: Tensor) -> Tensor:
    speed = low[..., 0] + (high[..., 0] - low[..., 0]) * shares[..., 0]
    return torch.stack((speed, high[..., 1] * shares[..., 1]), -1)


def mirrored_labels(labels: Tensor) -> Tensor:
    """Returns the mirror image of values by action, ``[..., ACTIONS]``: right turns become left ones."""
    return labels.unflatten(-1, (SPEEDS, TURNS)).flip(-1).flatten(-2)


class GridLogits(nn.Module):
    """Last layer of an actor on a grid: what it reads are logits, ``[..., ACTIONS]``, without a standard deviation."""

    def forward(self, logits: Tensor) -> tuple[Tensor, Tensor]:
        return logits, logits[..., :0]


class GridDistribution(Distribution):
    """Categorical distribution over the actions of a grid within bounds ``[2]``, or ``[..., 2]`` of each row.

    Its parameters are named as those of a normal distribution: ``loc [..., ACTIONS]`` are logits, ``scale`` is empty.

    Example:
        >>> low, high = torch.tensor([-1.0, -3.0]), torch.tensor([1.0, 3.0])
        >>> GridDistribution(torch.zeros(4, ACTIONS), torch.zeros(4, 0), low, high).sample().shape
        torch.Size([4, 2])
    """

    arg_constraints: ClassVar = {}

    def __init__(self, loc: Tensor, scale: Tensor, low: Tensor, high: Tensor) -> None:
        self.low, self.high = low.to(loc.device), high.to(loc.device)
        self.log_probs = loc.log_softmax(-1)
        super().__init__(loc.shape[:-1], torch.Size([2]), validate_args=False)

    @property
    def deterministic_sample(self) -> Tensor:
        """The most likely action, ``[..., 2]``."""
        return actions_at(self.log_probs.argmax(-1), self.low, self.high)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        # The largest of logits with Gumbel noise is a sample, without the checks of PyTorch's Categorical.
        noise = torch.empty_like(self.log_probs.expand(*sample_shape, *self.log_probs.shape)).exponential_().log()
        return actions_at((self.log_probs - noise).argmax(-1), self.low, self.high)

    def log_prob(self, action: Tensor) -> Tensor:
        index = nearest_index(action, self.low, self.high)
        return self.log_probs.expand(*index.shape, ACTIONS).gather(-1, index[..., None]).squeeze(-1)
