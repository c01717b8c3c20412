"""How often the policy succeeds in each world of a pool, and how much it can therefore learn there."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from rover_rl.sims.worlds.names import WorldName
from rover_rl.sims.worlds.pool import WorldPool

_HALF_LIFE = 2_000
"""Number of attempts, in all worlds together, after which an attempt counts half."""
_PRIOR_ATTEMPTS = 4.0
"""Number of attempts that the success rate of similar worlds counts for in the estimate of a world."""
_LEVELS = 10
"""Number of equal parts of the difficulties from 0 to 1."""


class Learnability:
    """Estimates the success rate p and the learnability p (1 - p) of each world of a pool from attempts in them.

    Learnability is that of Rutherford et al., "No Regrets: Investigating and Improving Regret Approximations for
    Curriculum Discovery" (SFL), NeurIPS 2024. It is the variance of success, 0.25 where every other attempt succeeds.

    Attempts lose weight with later ones, because the policy changes. Most worlds of a large pool have few attempts, so
    that the estimate of a world starts from that of its group: the worlds of the same name, with difficulties in the
    same tenth of the range from 0 to 1. The estimate of a group starts from that of the pool, and that of the pool from
    0.5. Each of them counts as four attempts.

    Args:
        pool: worlds.

    Attributes:
        attempts: number of attempts in each world, with their weights, float64 ``[len(pool)]``.
        successes: number of successful ones of them, float64 ``[len(pool)]``.
        difficulty: difficulty of each world, nan for those named without one, float64 ``[len(pool)]``.

    Example:
        >>> learnability = Learnability(WorldPool("maze:0-99@0-1"))
        >>> learnability.add(torch.tensor([3, 3]), successes=torch.tensor([1, 1]), failures=torch.tensor([0, 1]))
        >>> learnability.success_rate[3]
        tensor(0.6356, dtype=torch.float64)
    """

    def __init__(self, pool: WorldPool) -> None:
        sources = [pool.source(index) for index in range(len(pool))]
        names = [WorldName.parse(source) if isinstance(source, str) else WorldName("") for source in sources]
        self.difficulty = torch.tensor(
            [math.nan if name.difficulty is None else name.difficulty for name in names], dtype=torch.float64
        )
        groups: dict[tuple[str, int | None], int] = {}
        self._group = torch.tensor([groups.setdefault(_group(name), len(groups)) for name in names])
        # As often as in a draw without weights: each entry equally often, and each of its worlds.
        sizes = torch.tensor(pool.sizes)
        self._even = (1 / (len(sizes) * sizes.double())).repeat_interleave(sizes)
        self.attempts = torch.zeros(len(pool), dtype=torch.float64)
        self.successes = torch.zeros_like(self.attempts)

    def add(self, world: Tensor, successes: Tensor, failures: Tensor) -> None:
        """Adds attempts.

        Args:
            world: indices of worlds, int64, of any shape.
            successes: number of successful attempts in each, of the same shape.
            failures: number of failed attempts in each, of the same shape.
        """
        world, successes, failures = (values.flatten().cpu() for values in (world, successes, failures))
        attempts = successes + failures
        kept = 0.5 ** (attempts.sum().double() / _HALF_LIFE)
        self.attempts = (self.attempts * kept).index_add(0, world, attempts.double())
        self.successes = (self.successes * kept).index_add(0, world, successes.double())

    @property
    def success_rate(self) -> Tensor:
        """Estimated success rate of each world, float64 ``[len(pool)]``."""
        whole = _rate(self.successes.sum(), self.attempts.sum(), 0.5)
        zeros = torch.zeros(int(self._group.max()) + 1, dtype=torch.float64)
        successes, attempts = (zeros.index_add(0, self._group, each) for each in (self.successes, self.attempts))
        return _rate(self.successes, self.attempts, _rate(successes, attempts, whole)[self._group])

    @property
    def values(self) -> Tensor:
        """Estimated learnability p (1 - p) of each world, float64 ``[len(pool)]``."""
        rate = self.success_rate
        return rate * (1 - rate)

    def probabilities(self, share: float, temperature: float) -> Tensor:
        """Returns how often to draw each world, float64 ``[len(pool)]``.

        A part ``1 - share`` of the draws is even. In the other part, a world is the more likely the more learnable it
        is, with a weight of its learnability to the power of ``1 / temperature``.

        SFL draws evenly from a buffer of the most learnable worlds instead, whose estimates come from separate rollouts
        in a random sample. Weights need neither a size of the buffer for each size of a pool, nor a ranking of
        estimates that hardly differ.

        Args:
            share: part of the draws that depends on learnability, from 0 to 1.
            temperature: positive number. Low ones draw only the most learnable worlds.
        """
        values = self.values
        # Relative to the largest value, so that powers do not underflow everywhere.
        weights = self._even * (values / values.max()) ** (1 / temperature)
        return (1 - share) * self._even + share * weights / weights.sum()

    def state_dict(self) -> dict[str, Tensor]:
        """Returns the attempts."""
        return {"attempts": self.attempts, "successes": self.successes}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Loads a state that :meth:`state_dict` returned, of the same worlds."""
        self.attempts, self.successes = state["attempts"].clone(), state["successes"].clone()


def _rate(successes: Tensor, attempts: Tensor, prior: Tensor | float) -> Tensor:
    """Mean of the success rate under a beta distribution with the mean ``prior`` before the attempts."""
    return (successes + _PRIOR_ATTEMPTS * prior) / (attempts + _PRIOR_ATTEMPTS)


def _group(name: WorldName) -> tuple[str, int | None]:
    """Worlds of equal groups are similar."""
    level = name.difficulty
    return name.part, None if level is None else min(int(level * _LEVELS), _LEVELS - 1)
