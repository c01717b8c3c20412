"""Evaluations that run on all CPU cores of this machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from operator import methodcaller
from typing import Any, TypeAlias

from rover_rl.algos.evaluation.cores import over_cores
from rover_rl.algos.evaluation.episodes import DEFAULT_SEED, EpisodeSet
from rover_rl.algos.evaluation.evaluate import (
    EndlessEvaluation,
    Evaluation,
    Policy,
    check_options,
    environment_for,
    evaluate,
    evaluate_endless,
    usual_seconds,
)
from rover_rl.checks import MAX_COUNT, check_at_least
from rover_rl.envs import EnvConfig
from rover_rl.worlds import World

EPISODES_PER_PART = 32
"""Number of episodes that one process evaluates at a time. It does not depend on the number of cores, so that the
results of randomized environments do not, either."""
BATCHED_PER_PART = 128  # the same for several worlds in Warp, which steps many rovers almost as fast as few
SMALL = 16  # number of episodes below which starting processes takes longer than the evaluation
ROWS = 8
"""Number of rovers of an evaluation with one goal per episode in one world. With more rovers, more of them wait for the
last one. In several worlds, each episode of a part has a rover, as rovers stay in their worlds."""


@dataclass(frozen=True)
class GoalRequest:
    """Request for an evaluation with one goal per episode, with further arguments of ``evaluate``."""

    policy: Policy | None
    episodes: EpisodeSet
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Number of episodes."""
        return len(self.episodes)

    def parts(self) -> list[GoalRequest]:
        """Divides the episodes."""
        env = self.options.get("env")
        batched = self.episodes.several_worlds and env is not None and env.backend == "warp"
        size = _whole_groups(BATCHED_PER_PART if batched else EPISODES_PER_PART, env)
        parts = (self.episodes.part(first, first + size) for first in range(0, self.count, size))
        # The usual time limit is that of the whole set.
        usual = {"seconds": usual_seconds(environment_for(self.policy, env), self.episodes)}
        options = usual | {name: value for name, value in self.options.items() if value is not None}
        return [replace(self, episodes=part.with_used_worlds(), options=options) for part in parts]

    def run(self) -> Evaluation:
        """Evaluates the policy in this process. The result has no episodes: :meth:`merge` adds them."""
        rows = self.count if self.episodes.several_worlds else ROWS
        return replace(evaluate(self.policy, self.episodes, rows=rows, **self.options), episodes=None)  # type: ignore[arg-type]

    def merge(self, parts: Sequence[Any]) -> Evaluation:
        """Joins the results of :meth:`parts`."""
        return replace(parts[0], episodes=self.episodes, trajectories=[t for part in parts for t in part.trajectories])


@dataclass(frozen=True)
class EndlessRequest:
    """Request for an evaluation in endless mode, with further arguments of ``evaluate_endless``."""

    policy: Policy | None
    world: str | World
    options: dict[str, Any] = field(default_factory=dict)
    rows: int = 32
    seed: int = DEFAULT_SEED
    offset: int = 0

    @property
    def count(self) -> int:
        """Number of episodes."""
        return self.rows

    def parts(self) -> list[EndlessRequest]:
        """Divides the episodes."""
        check_options(rows=self.rows)
        size = _whole_groups(ROWS, self.options.get("env"))
        firsts = range(0, self.rows, size)
        return [replace(self, rows=min(size, self.rows - first), offset=self.offset + first) for first in firsts]

    def run(self) -> EndlessEvaluation:
        """Evaluates the policy in this process."""
        episodes: dict[str, Any] = {"rows": self.rows, "seed": self.seed, "offset": self.offset}
        return evaluate_endless(self.policy, self.world, **episodes, **self.options)

    def merge(self, parts: Sequence[Any]) -> EndlessEvaluation:
        """Joins the results of :meth:`parts`."""
        env = replace(parts[0].env, num_envs=self.rows)
        return replace(parts[0], trajectories=[t for part in parts for t in part.trajectories], env=env)


Request: TypeAlias = GoalRequest | EndlessRequest


def evaluate_all(requests: Sequence[Request], workers: int | None = None) -> list[Evaluation | EndlessEvaluation]:
    """Evaluates policies on all CPU cores and returns the results in the order of the requests.

    The results are bit-identical for any number of cores. Small evaluations, and those on a GPU, run in this process.
    Programs that call this function need the guard ``if __name__ == "__main__":``, as all that start processes do.
    """
    if workers is not None:
        check_at_least(1, MAX_COUNT, workers=workers)
    envs = [request.options.get("env") for request in requests]
    on_gpu = any(env is not None and env.device not in (None, "cpu") for env in envs)
    if sum(request.count for request in requests) < SMALL or on_gpu:
        workers = 1
    parts = [request.parts() for request in requests]
    flat = [part for several in parts for part in several]
    results = iter(over_cores(methodcaller("run"), flat, "evaluating", workers))
    return [request.merge([next(results) for _ in several]) for request, several in zip(requests, parts, strict=True)]


def _whole_groups(rows: int, env: EnvConfig | None) -> int:
    agents = 1 if env is None else env.agents
    return max(agents, rows - rows % agents)
