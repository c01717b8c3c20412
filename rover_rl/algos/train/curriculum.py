"""Curriculum over the worlds of a pool: which worlds episodes draw in training, and a record of it."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.algos.config import TrainingConfig
from rover_rl.algos.train.attempts import AttemptEntries
from rover_rl.algos.train.learnability import Learnability
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.task import StepEvent
from rover_rl.envs.transforms.path_reward import world_of
from rover_rl.files import written_whole
from rover_rl.sims.worlds.pool import WorldPool

RECORD = "curriculum.csv"
"""Name of the table of the worlds that were drawn, in a run's folder."""
_UPDATE_ATTEMPTS = 64
"""Number of attempts after which the weights of the worlds are updated."""


class Curriculum(AttemptEntries):
    """Lets episodes draw the worlds in which the policy sometimes succeeds and sometimes fails.

    An attempt is the way to one goal. It succeeds at the goal. It fails if the episode ends before it otherwise, or at
    the time limit if at least half of the episode went into it. The last attempts of other episodes do not count. The
    transform estimates the :class:`~rover_rl.algos.train.learnability.Learnability` of the worlds from the attempts of
    all rows, and updates the weights of the draw after at least 64 attempts
    (:meth:`~rover_rl.RoverEnv.set_world_weights`).

    It adds the nested entry ``attempt``, each int64 ``[N, 1]``:

    - ``("attempt", "begun")``: number of steps of the episode before the current attempt;
    - ``("attempt", "succeeded")``: number of attempts that succeeded in this step;
    - ``("attempt", "failed")``: number of attempts that failed in this step.

    Append it after :class:`~rover_rl.envs.transforms.action_repeat.ActionRepeat`, and before transforms that truncate
    episodes.

    Args:
        env (rover_rl.RoverEnv): environment that draws worlds.
        share: part of the episodes that draws by learnability, from 0 to 1. The others draw evenly.
        temperature: temperature of these draws: see
            :meth:`~rover_rl.algos.train.learnability.Learnability.probabilities`.
        estimates (dict): state of the ``learnability`` to begin with. ``None`` knows nothing of the worlds.
        per_batch: whether the estimates learn from whole batches, with ``batch_collected()``, instead of from each
            step. On a GPU, the host waits for the device each time they learn.

    Attributes:
        learnability: estimates of the worlds.

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
        self._share, self._temperature, self._length = share, temperature, env.length
        self._per_batch = per_batch
        self._set_weights = env.set_world_weights
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
        """Adds attempts to the estimates."""
        attempts = int((succeeded + failed).sum())
        if attempts:
            self.learnability.add(world, succeeded, failed)
            self._attempts += attempts
        if self._attempts >= _UPDATE_ATTEMPTS:
            self._update_weights()


class CurriculumRecord:
    """Worlds that a training run has drawn, and what the policy did in them, in all workers and sessions.

    Args:
        config: settings of the training run.

    Attributes:
        learnability: estimates from the attempts of all workers.
    """

    def __init__(self, config: TrainingConfig) -> None:
        self._names = config.env.world_names
        self._pool = WorldPool.of(config.env.world)
        self.learnability = Learnability(self._pool)
        self._totals = torch.zeros(len(self._pool), 3, dtype=torch.int64)

    def __call__(self, batch: TensorDictBase) -> dict[str, float]:
        """Adds a batch of decisions ``[N, T]``.

        Returns:
            Mean learnability and difficulty of the worlds that were drawn in the batch. Worlds without a difficulty do
            not count. Means over nothing are nan.
        """
        drawn = world_of(batch)[batch["step_count"] == 0].cpu()
        learnability, difficulty = self.learnability.values[drawn], self.learnability.difficulty[drawn]
        after = batch["next"]
        world, succeeded, failed = (
            each.flatten().cpu()
            for each in (world_of(after), after[Curriculum.key, "succeeded"], after[Curriculum.key, "failed"])
        )
        self.learnability.add(world, succeeded, failed)
        draws, attempts, successes = self._totals.unbind(-1)
        draws.index_add_(0, drawn, torch.ones_like(drawn))
        attempts.index_add_(0, world, succeeded + failed)
        successes.index_add_(0, world, succeeded)
        return {"drawn_learnability": learnability.mean().item(), "drawn_difficulty": difficulty.nanmean().item()}

    def write(self, folder: Path) -> None:
        """Writes the table of the drawn worlds, the most frequent ones first."""
        draws = self._totals[:, 0]
        rates, values = self.learnability.success_rate, self.learnability.values
        header = ("world", "draws", "attempts", "successes", "success_rate", "learnability")
        with written_whole(folder / RECORD) as temporary, temporary.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            for index in draws.argsort(descending=True, stable=True)[: int((draws > 0).sum())].tolist():
                estimates = (f"{each[index].item():.4f}" for each in (rates, values))
                writer.writerow((self._pool.name(index), *self._totals[index].tolist(), *estimates))

    def state_dict(self) -> dict[str, Any]:
        """Returns the names of the worlds, and all counts."""
        return {"worlds": self._names, "totals": self._totals, **self.learnability.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Loads a state that :meth:`state_dict` returned. Ignores that of a run that has been in other worlds."""
        if state["worlds"] == self._names:
            self._totals = state["totals"].clone()
            self.learnability.load_state_dict(state)
