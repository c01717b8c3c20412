"""Results of evaluations."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from rover_rl.algos.evaluation.episodes import EpisodeSet
from rover_rl.algos.evaluation.metrics import Estimate, Trajectory, count_runs, endless_metrics, goal_metrics
from rover_rl.envs.config import EnvConfig, plain_env
from rover_rl.sims.backends import name_of
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import World


@dataclass(frozen=True)
class Evaluation:
    """Results of a policy on episodes with one goal each.

    Attributes:
        name: name of the policy.
        episodes: starts and goals of the episodes.
        action_repeat: number of steps that each action was held for.
        seconds: time limit of an episode, s.
        trajectories: trajectory of each episode.
        env: settings of the environment.
    """

    name: str
    episodes: EpisodeSet
    action_repeat: int
    seconds: float
    trajectories: list[Trajectory]
    env: EnvConfig = field(default_factory=EnvConfig)

    @property
    def backend(self) -> str:
        """Name of the backend; ``"module:class"`` of a custom one that is given as an object."""
        return _backend_name(self.env)

    @property
    def endings(self) -> list[str]:
        """Ending of each episode: ``"goal"``, ``"time limit"`` or an early ending."""
        return [trajectory.ending for trajectory in self.trajectories]

    @property
    def steps(self) -> Tensor:
        """Number of steps of each episode, int64 ``[count]``."""
        return torch.tensor([len(trajectory) for trajectory in self.trajectories])

    @property
    def paths(self) -> list[Tensor]:
        """Positions at the start and after each step: ``[T + 1, 2]`` each, m."""
        return [trajectory.path for trajectory in self.trajectories]

    @property
    def reached(self) -> Tensor:
        """Whether each episode reached its goal, bool ``[count]``."""
        return torch.tensor([ending == "goal" for ending in self.endings])

    @cached_property
    def metrics(self) -> dict[str, Estimate]:
        """Metrics, by name: see :mod:`rover_rl.algos.evaluation.metrics`."""
        return goal_metrics(
            self.trajectories, self.episodes.shortest, self.episodes.world, robot=get_robot(self.env.robot)
        )

    @property
    def success_rate(self) -> float:
        """Fraction of episodes that reached their goal."""
        return self.reached.double().mean().item()

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of the success rate."""
        estimate = self.metrics["success_rate"]
        return estimate.low, estimate.high

    @property
    def mean_time(self) -> float:
        """Mean time to the goal over the episodes that reached it, s; nan if none did."""
        return self.metrics["mean_time_to_traverse"].value

    @property
    def goals_per_2000_steps(self) -> float:
        """Number of goals reached per 2,000 steps, the length of a full episode."""
        return int(self.reached.sum()) * EnvConfig.length / int(self.steps.sum())

    @property
    def title(self) -> str:
        """Title of a table with these results."""
        return f"{len(self.episodes)} episodes in {self.episodes.name}: one goal within {self.seconds:g} s"

    def summary(self) -> dict[str, Any]:
        """Returns policy, backend, world and counts as plain data."""
        episodes = self.episodes
        return {
            "policy": self.name,
            "backend": self.backend,
            "world": episodes.name,
            "mode": "one goal",
            "seed": episodes.seed,
            "action_repeat": self.action_repeat,
            **_counts(self.trajectories),
            "time_limit": self.seconds,
        }

    def to_json(self) -> dict[str, Any]:
        """Returns all results except the trajectories as plain data."""
        episodes = self.episodes
        columns = (episodes.start.tolist(), episodes.goal.tolist(), episodes.shortest.tolist())
        rows = zip(*columns, self.trajectories, strict=True)
        return {
            **_results(self),
            "episodes": [
                {"start": start, "goal": goal, "shortest": shortest, "length": t.length, **_episode(t)}
                for start, goal, shortest, t in rows
            ],
        }


@dataclass(frozen=True)
class EndlessEvaluation:
    """Results of a policy in endless mode, in which each reached goal is followed by a new one, as in the original.

    Attributes:
        name: name of the policy.
        world_name: name of the world, as the user gave it.
        world: world of the episodes.
        seed: seed of the first episode.
        action_repeat: number of steps that each action was held for.
        jam: whether a long collision ended an episode.
        length: number of steps after which an episode ended.
        trajectories: trajectory of each episode.
        env: settings of the environment.
    """

    name: str
    world_name: str
    world: World
    seed: int
    action_repeat: int
    jam: bool
    length: int
    trajectories: list[Trajectory]
    env: EnvConfig = field(default_factory=EnvConfig)

    @property
    def backend(self) -> str:
        """Name of the backend; ``"module:class"`` of a custom one that is given as an object."""
        return _backend_name(self.env)

    @cached_property
    def metrics(self) -> dict[str, Estimate]:
        """Metrics, by name: see :mod:`rover_rl.algos.evaluation.metrics`."""
        return endless_metrics(self.trajectories, self.world, robot=get_robot(self.env.robot))

    @property
    def title(self) -> str:
        """Title of a table with these results."""
        count, limit = len(self.trajectories), f"{self.length:,} steps"
        jam = "" if self.jam else ", without the jam ending"
        return f"{count} episodes in {self.world_name}: endless goals, {limit} each{jam}"

    def summary(self) -> dict[str, Any]:
        """Returns policy, backend, world and counts as plain data."""
        return {
            "policy": self.name,
            "backend": self.backend,
            "world": self.world_name,
            "mode": "endless",
            "seed": self.seed,
            "action_repeat": self.action_repeat,
            **_counts(self.trajectories),
            "time_limit": self.length * self.trajectories[0].dt,
            "jam": self.jam,
        }

    def to_json(self) -> dict[str, Any]:
        """Returns all results except the trajectories as plain data."""
        episodes = [{"goals": int(t.goal.sum()), **_episode(t)} for t in self.trajectories]
        return {**_results(self), "episodes": episodes}


def _backend_name(env: EnvConfig) -> str:
    return env.backend if isinstance(env.backend, str) else name_of(env.backend)


def _counts(trajectories: Sequence[Trajectory]) -> dict[str, int]:
    """Numbers of episodes, goals and collisions, by name."""
    return {
        "count": len(trajectories),
        "goals": sum(int(t.goal.sum()) for t in trajectories),
        "collisions": sum(count_runs(t.collision) for t in trajectories),
    }


def _results(evaluation: Evaluation | EndlessEvaluation) -> dict[str, Any]:
    """Returns the summary, environment, metrics and endings of an evaluation as plain data."""
    metrics = {
        key: {field: number if math.isfinite(number) else None for field, number in vars(estimate).items()}
        for key, estimate in evaluation.metrics.items()
    }
    endings = Counter(trajectory.ending for trajectory in evaluation.trajectories)
    return {
        **evaluation.summary(),
        "env": _plain_env_or_none(evaluation.env),
        "metrics": metrics,
        "endings": dict(endings),
    }


def _plain_env_or_none(env: EnvConfig) -> dict[str, Any] | None:
    """Returns the settings as plain data, ``None`` if they contain objects that have no plain form."""
    try:
        return plain_env(env)
    except ValueError:
        return None


def _episode(trajectory: Trajectory) -> dict[str, Any]:
    """Returns the ending and the duration of an episode as plain data."""
    return {"ending": trajectory.ending, "seconds": round(trajectory.seconds, 3)}
