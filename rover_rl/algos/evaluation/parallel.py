"""Evaluations that run on all CPU cores of this machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from operator import methodcaller
from typing import Any

from rover_rl.algos.evaluation.cores import over_cores
from rover_rl.algos.evaluation.episodes import EpisodeSet
from rover_rl.algos.evaluation.evaluate import environment_for, evaluate, usual_seconds
from rover_rl.algos.evaluation.results import EPISODES_PER_PART, Evaluation
from rover_rl.algos.policy.runner import Policy
from rover_rl.checks import MAX_COUNT, check_at_least

BATCHED_PER_PART = 128  # EPISODES_PER_PART of several worlds in Warp, which steps many rovers almost as fast as few
SMALL = 16  # number of episodes below which starting processes takes longer than the evaluation
ROWS = 8
"""Number of rovers of an evaluation in one world. With more rovers, more of them wait for the last one. In several
worlds, each episode of a part has a rover, as rovers stay in their worlds."""


@dataclass(frozen=True)
class Request:
    """Request for an evaluation, with further arguments of ``evaluate``."""

    policy: Policy | None
    episodes: EpisodeSet
    options: dict[str, Any] = field(default_factory=dict)

    def parts(self) -> list[Request]:
        episodes, env = self.episodes, self.options.get("env")
        batched = episodes.several_worlds and env is not None and env.backend == "warp"
        size, agents = BATCHED_PER_PART if batched else EPISODES_PER_PART, 1 if env is None else env.agents
        size = ROWS if episodes.endless else size
        # Whole groups, at least one.
        size = max(agents, size - size % agents)
        parts = (episodes.part(first, first + size) for first in range(0, len(episodes), size))
        # The usual time limit is that of the whole set.
        usual = {"seconds": usual_seconds(environment_for(self.policy, env), episodes)}
        options = usual | {name: value for name, value in self.options.items() if value is not None}
        return [replace(self, episodes=part.with_used_worlds(), options=options) for part in parts]

    def run(self) -> Evaluation:
        """Evaluates the policy in this process. The result has no episodes: :meth:`merge` adds them."""
        rows = len(self.episodes) if self.episodes.several_worlds else ROWS
        return replace(evaluate(self.policy, self.episodes, rows=rows, **self.options), episodes=None)  # type: ignore[arg-type]

    def merge(self, parts: Sequence[Evaluation]) -> Evaluation:
        trajectories = [t for part in parts for t in part.trajectories]
        env = replace(parts[0].env, num_envs=len(trajectories)) if self.episodes.endless else parts[0].env
        return replace(parts[0], episodes=self.episodes, trajectories=trajectories, env=env)


def evaluate_all(requests: Sequence[Request], workers: int | None = None) -> list[Evaluation]:
    """Evaluates policies on all CPU cores and returns the results in the order of the requests.

    The results are bit-identical for any number of cores. Small evaluations, and those on a GPU, run in this process.
    Programs that call this function need the guard ``if __name__ == "__main__":``, as all that start processes do.
    """
    if workers is not None:
        check_at_least(1, MAX_COUNT, workers=workers)
    envs = [request.options.get("env") for request in requests]
    on_gpu = any(env is not None and env.device not in (None, "cpu") for env in envs)
    if sum(len(request.episodes) for request in requests) < SMALL or on_gpu:
        workers = 1
    parts = [request.parts() for request in requests]
    flat = [part for several in parts for part in several]
    results = iter(over_cores(methodcaller("run"), flat, "evaluating", workers))
    return [request.merge([next(results) for _ in several]) for request, several in zip(requests, parts, strict=True)]
