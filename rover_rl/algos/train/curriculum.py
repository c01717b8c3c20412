"""Curriculum over the worlds of a pool: which worlds episodes draw in training, and a record of it."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.algos.config import TrainingConfig
from rover_rl.algos.train.attempts import AttemptEntries
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.task import StepEvent
from rover_rl.envs.transforms.path_reward import world_of
from rover_rl.files import written_whole
from rover_rl.names import Name
from rover_rl.sims.free_space.fitting import RobotGroups
from rover_rl.worlds.pool import WorldPool

_UPDATE_ATTEMPTS = 64  # number of attempts after which the weights of the worlds are updated
_HALF_LIFE = 2_000  # number of attempts, in all worlds together, after which an attempt counts half
# Number of attempts that the success rate of similar worlds counts for in the estimate of a world.
_PRIOR_ATTEMPTS = 4.0
_LEVELS = 10  # number of equal parts of the difficulties from 0 to 1


class Learnability:
    """Estimates the success rate p and the learnability p (1 - p) of each world of a pool from attempts in them.

    Learnability is that of Rutherford et al., "No Regrets: Investigating and Improving Regret Approximations for
    Curriculum Discovery" (SFL), NeurIPS 2024. It is the variance of success, 0.25 where every other attempt succeeds.

    Attempts lose weight with later ones, because the policy changes. Most worlds of a large pool have few attempts, so
    that the estimate of a world starts from that of the worlds of the same name and a similar difficulty, theirs from
    that of the pool, and that from 0.5. Each of these counts as four attempts.

    ``attempts`` and ``successes`` are those in each world, with their weights; ``difficulty`` is nan for worlds that
    are named without one; all float64 ``[len(pool)]``.

    Example:
        >>> learnability = Learnability(WorldPool("maze:0-99@0-1"))
        >>> learnability.add(torch.tensor([3, 3]), successes=torch.tensor([1, 1]), failures=torch.tensor([0, 1]))
        >>> learnability.success_rate[3]
        tensor(0.6356, dtype=torch.float64)
    """

    def __init__(self, pool: WorldPool) -> None:
        sources = [pool.source(index) for index in range(len(pool))]
        names = [Name.parse(source) if isinstance(source, str) else Name("") for source in sources]
        difficulties = [name.settings.get("difficulty", math.nan) for name in names]
        self.difficulty = torch.tensor(difficulties, dtype=torch.float64)
        groups: dict[tuple[str, int | None], int] = {}
        self._group = torch.tensor([groups.setdefault(_group(name), len(groups)) for name in names])
        self._even = torch.tensor(pool.shares_of_worlds, dtype=torch.float64)
        self.attempts = torch.zeros(len(pool), dtype=torch.float64)
        self.successes = torch.zeros_like(self.attempts)

    def add(self, world: Tensor, successes: Tensor, failures: Tensor) -> None:
        """Adds numbers of successful and failed attempts in worlds, given by their indices. All int64, of one shape."""
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
        rate = self.success_rate
        return rate * (1 - rate)

    def probabilities(self, share: float, temperature: float) -> Tensor:
        """Returns how often to draw each world, float64 ``[len(pool)]``.

        A part ``1 - share`` of the draws is even. In the other part, the weight of a world is its learnability to the
        power of ``1 / temperature``: low temperatures draw only the most learnable worlds. (SFL draws evenly from a
        buffer of these instead, whose size would depend on that of the pool.)
        """
        values = self.values
        # Relative to the largest value, so that powers do not underflow everywhere.
        weights = self._even * (values / values.max()) ** (1 / temperature)
        return (1 - share) * self._even + share * weights / weights.sum()

    def state_dict(self) -> dict[str, Tensor]:
        return {"attempts": self.attempts, "successes": self.successes}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        self.attempts, self.successes = state["attempts"].clone(), state["successes"].clone()


def _rate(successes: Tensor, attempts: Tensor, prior: Tensor | float) -> Tensor:
    return (successes + _PRIOR_ATTEMPTS * prior) / (attempts + _PRIOR_ATTEMPTS)


def _group(name: Name) -> tuple[str, int | None]:
    level = name.settings.get("difficulty")
    return name.part, None if level is None else min(int(level * _LEVELS), _LEVELS - 1)


class Curriculum(AttemptEntries):
    """Lets episodes draw the worlds in which the policy sometimes succeeds and sometimes fails.

    An attempt is the way to one goal. It succeeds at the goal. It fails if the episode ends before it otherwise, or at
    the time limit if at least half of the episode went into it. Those of all rows estimate the :class:`Learnability` of
    the worlds, and update the weights of the draw after every 64 of them
    (:meth:`~rover_rl.RoverEnv.set_world_weights`).

    It adds the nested entry ``attempt``, each int64 ``[N, 1]``: ``begun``, the number of steps of the episode before
    the current attempt, ``succeeded`` and ``failed``, the numbers of attempts that did so in this step.

    Append it after :class:`~rover_rl.envs.transforms.action_repeat.ActionRepeat`, and before transforms that truncate
    episodes.

    Args:
        share, temperature: see :meth:`Learnability.probabilities`.
        estimates: state of the ``learnability`` to begin with. ``None`` knows nothing of the worlds.
        per_batch: whether the estimates learn from whole batches, with ``batch_collected()``, instead of from each
            step. On a GPU, the host waits for the device each time they learn.

    Raises:
        ValueError: if the environment does not draw a world for each episode.
    """

    key, entries = "attempt", ("begun", "succeeded", "failed")

    def __init__(
        self,
        env: RoverEnv,
        share: float,
        temperature: float,
        estimates: Mapping[str, Tensor] | None = None,
        per_batch: bool = False,
    ) -> None:
        super().__init__()
        self.learnability = Learnability(env.pool)
        if estimates is not None:
            self.learnability.load_state_dict(estimates)
        self._share, self._temperature = share, temperature
        self._length, self._per_batch, self._set_weights = env.length, per_batch, env.set_world_weights
        self._update_weights()

    def _update_weights(self) -> None:
        self._attempts = 0
        self._set_weights(self.learnability.probabilities(self._share, self._temperature))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        outcome = next_tensordict["outcome"]
        steps, succeeded = outcome["steps"], outcome["goals"]
        begun = torch.where(succeeded > 0, steps, tensordict[self.key, "begun"])
        timed_out = next_tensordict["truncated"] & (2 * (steps - begun) >= self._length)
        failed = timed_out | next_tensordict["terminated"] & (outcome["phase"] < StepEvent.GOAL)
        if not self._per_batch:
            self._add(world_of(next_tensordict), succeeded, failed.long())
        return self._with_entries(next_tensordict, begun, succeeded, failed.long())

    def batch_collected(self, batch: TensorDictBase) -> None:
        """Learns from a batch ``[N, T]`` if the estimates do so per batch."""
        if self._per_batch:
            after = batch["next"]
            self._add(world_of(after), after[self.key, "succeeded"], after[self.key, "failed"])

    def _add(self, world: Tensor, succeeded: Tensor, failed: Tensor) -> None:
        attempts = int((succeeded + failed).sum())
        if attempts:
            self.learnability.add(world, succeeded, failed)
            self._attempts += attempts
        if self._attempts >= _UPDATE_ATTEMPTS:
            self._update_weights()


class CurriculumRecord:
    """Worlds that a training run has drawn, and what the policy did in them, in all workers and sessions."""

    def __init__(self, config: TrainingConfig) -> None:
        self._names = config.env.world_names
        env = config.env.fitted()
        worlds, _ = RobotGroups(env.robot).spread(env.world)
        self._pool = WorldPool.of(worlds)
        self.learnability = Learnability(self._pool)
        self._totals = torch.zeros(len(self._pool), 3, dtype=torch.int64)

    def __call__(self, batch: TensorDictBase) -> dict[str, float]:
        """Adds a batch of decisions ``[N, T]``; returns the mean learnability and difficulty of the worlds drawn in it.

        Worlds without a difficulty do not count. Means over nothing are nan.
        """
        drawn = world_of(batch)[batch["step_count"] == 0].cpu()
        learnability, difficulty = self.learnability.values[drawn], self.learnability.difficulty[drawn]
        after = batch["next"]
        counted = world_of(after), after[Curriculum.key, "succeeded"], after[Curriculum.key, "failed"]
        world, succeeded, failed = (each.flatten().cpu() for each in counted)
        self.learnability.add(world, succeeded, failed)
        draws, attempts, successes = self._totals.unbind(-1)
        draws.index_add_(0, drawn, torch.ones_like(drawn))
        attempts.index_add_(0, world, succeeded + failed)
        successes.index_add_(0, world, succeeded)
        return {"drawn_learnability": learnability.mean().item(), "drawn_difficulty": difficulty.nanmean().item()}

    def write(self, folder: Path) -> None:
        """Writes ``curriculum.csv``, the table of the drawn worlds, the most frequent ones first."""
        draws = self._totals[:, 0]
        rates, values = self.learnability.success_rate, self.learnability.values
        header = ("world", "draws", "attempts", "successes", "success_rate", "learnability")
        with written_whole(folder / "curriculum.csv") as temporary, temporary.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            for index in draws.argsort(descending=True, stable=True)[: int((draws > 0).sum())].tolist():
                estimates = (f"{each[index].item():.4f}" for each in (rates, values))
                writer.writerow((self._pool.name(index), *self._totals[index].tolist(), *estimates))

    def state_dict(self) -> dict[str, Any]:
        return {"worlds": self._names, "totals": self._totals, **self.learnability.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        if state["worlds"] == self._names:
            self._totals = state["totals"].clone()
            self.learnability.load_state_dict(state)
