"""Results of evaluations."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from rover_rl.algos.evaluation.episodes import EpisodeSet
from rover_rl.algos.evaluation.metrics import (
    Estimate,
    Trajectory,
    count_runs,
    endless_metrics,
    find_body_contacts,
    goal_metrics,
)
from rover_rl.envs.config import EnvConfig, plain_env
from rover_rl.sims.backends import name_of
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import World

WORST = 6
"""Number of worlds with the lowest success rates that are named and drawn."""


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
    def contacts(self) -> list[Tensor]:
        """Whether the body touches an obstacle at the start and after each step: bool ``[T + 1]`` each."""
        return find_body_contacts(self.trajectories, self._world_or_worlds, get_robot(self.env.robot))

    @property
    def _world_or_worlds(self) -> World | list[World]:
        return self.episodes.worlds if self.episodes.several_worlds else self.episodes.world

    @cached_property
    def metrics(self) -> dict[str, Estimate]:
        """Metrics, by name: see :mod:`rover_rl.algos.evaluation.metrics`."""
        shortest, robot = self.episodes.shortest, get_robot(self.env.robot)
        return goal_metrics(self.trajectories, shortest, self._world_or_worlds, robot=robot, contacts=self.contacts)

    @property
    def world_name(self) -> str:
        """Name of the world or of the range of worlds, as the user gave it."""
        return self.episodes.name

    @cached_property
    def by_world(self) -> list[dict[str, Any]]:
        """Results in each world, in the order of the pool.

        The keys are ``world`` (index in the pool), ``name``, ``count``, ``success_rate``, ``contact_free_success_rate``
        and ``mean_time_to_traverse`` (s, ``None`` if no goal was reached).
        """
        members: dict[int, list[int]] = {}
        for episode, index in enumerate(self.episodes.world_index.tolist()):
            members.setdefault(index, []).append(episode)
        return [self._in_world(index, members[index]) for index in sorted(members)]

    def _in_world(self, index: int, episodes: Sequence[int]) -> dict[str, Any]:
        reached = [episode for episode in episodes if self.trajectories[episode].ending == "goal"]
        clean = [episode for episode in reached if not self.contacts[episode].any()]
        seconds = [self.trajectories[episode].seconds for episode in reached]
        return {
            "world": index,
            "name": self.episodes.world_name(episodes[0]),
            "count": len(episodes),
            "success_rate": len(reached) / len(episodes),
            "contact_free_success_rate": len(clean) / len(episodes),
            "mean_time_to_traverse": round(sum(seconds) / len(seconds), 3) if seconds else None,
        }

    def episode_rows(self) -> list[dict[str, Any]]:
        """Returns a row of plain values for each episode, as in ``evaluation.csv``."""
        episodes = self.episodes
        columns = (episodes.start.tolist(), episodes.goal.tolist(), episodes.shortest.tolist())
        rows = zip(*columns, self.trajectories, self.contacts, strict=True)
        return [
            {
                **_identity(self, number, episodes.world_name(number)),
                **dict(zip(("start_x", "start_y", "start_yaw"), start, strict=True)),
                **dict(zip(("goal_x", "goal_y"), goal, strict=True)),
                "shortest": shortest,
                "length": t.length,
                **_episode(t, touched),
                "success": t.ending == "goal",
            }
            for number, (start, goal, shortest, t, touched) in enumerate(rows)
        ]

    def select(self, indices: Sequence[int]) -> Evaluation:
        """Returns the results of the episodes with the given indices."""
        trajectories = [self.trajectories[index] for index in indices]
        return replace(self, episodes=self.episodes.select(indices), trajectories=trajectories)

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
        episodes, limit = self.episodes, f"one goal within {self.seconds:g} s"
        if not episodes.several_worlds:
            return f"{_episodes(len(episodes))} in {episodes.name}: {limit}"
        counts = {world["count"] for world in self.by_world}
        each = f"{_episodes(counts.pop())} in each" if len(counts) == 1 else _episodes(len(episodes))
        return f"{each} of {len(self.by_world)} worlds, {episodes.name}: {limit}"

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
        rows = zip(*columns, self.trajectories, self.contacts, strict=True)
        results = [
            {"start": start, "goal": goal, "shortest": shortest, "length": t.length, **_episode(t, touched)}
            for start, goal, shortest, t, touched in rows
        ]
        if not episodes.several_worlds:
            return {**_results(self), "episodes": results}
        indices = episodes.world_index.tolist()
        results = [{"world": index, **result} for index, result in zip(indices, results, strict=True)]
        return {**_results(self), "worlds": self.by_world, "episodes": results}


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
        robot = get_robot(self.env.robot)
        return endless_metrics(self.trajectories, self.world, robot=robot, contacts=self.contacts)

    @property
    def title(self) -> str:
        """Title of a table with these results."""
        count, limit = len(self.trajectories), f"{self.length:,} steps"
        jam = "" if self.jam else ", without the jam ending"
        return f"{_episodes(count)} in {self.world_name}: endless goals, {limit} each{jam}"

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
        return {**_results(self), "episodes": self._episodes}

    @cached_property
    def contacts(self) -> list[Tensor]:
        """Whether the body touches an obstacle at the start and after each step: bool ``[T + 1]`` each."""
        return find_body_contacts(self.trajectories, self.world, get_robot(self.env.robot))

    @property
    def _episodes(self) -> list[dict[str, Any]]:
        both = zip(self.trajectories, self.contacts, strict=True)
        return [{"goals": int(t.goal.sum()), **_episode(t, touched)} for t, touched in both]

    def episode_rows(self) -> list[dict[str, Any]]:
        """Returns a row of plain values for each episode, as in ``evaluation.csv``."""
        return [{**_identity(self, number, self.world_name), **row} for number, row in enumerate(self._episodes)]


def worst_worlds(evaluations: Sequence[Evaluation], count: int = WORST) -> list[int]:
    """Returns the indices of the worlds with the lowest mean success rates, the lowest first.

    Among worlds with equal success rates, those with more contacts and longer times come first.

    Args:
        evaluations: evaluations on the same episodes.
        count: largest number of worlds.
    """

    def merit(index: int) -> tuple[float, float, float]:
        results = [evaluation.by_world[index] for evaluation in evaluations]
        times = [-(result["mean_time_to_traverse"] or math.inf) for result in results]
        keys = ("success_rate", "contact_free_success_rate")
        success, clean = (sum(result[key] for result in results) for key in keys)
        return success, clean, sum(times)

    order = sorted(range(len(evaluations[0].by_world)), key=merit)
    return [evaluations[0].by_world[index]["world"] for index in order[:count]]


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
        "env": plain_env_or_none(evaluation.env),
        "metrics": metrics,
        "endings": dict(endings),
    }


def plain_env_or_none(env: EnvConfig) -> dict[str, Any] | None:
    """Returns the settings as plain data, ``None`` if they contain objects that have no plain form."""
    try:
        return plain_env(env)
    except ValueError:
        return None


def _identity(evaluation: Evaluation | EndlessEvaluation, episode: int, world: str) -> dict[str, Any]:
    """Returns what a row of an episode begins with."""
    summary = evaluation.summary()
    return {key: summary[key] for key in ("policy", "backend", "mode", "seed", "action_repeat")} | {
        "world": world,
        "episode": episode,
    }


def _episode(trajectory: Trajectory, touched: Tensor) -> dict[str, Any]:
    """Returns ending, duration and events of an episode as plain data."""
    return {
        "ending": trajectory.ending,
        "seconds": round(trajectory.seconds, 3),
        "contacts": count_runs(touched),
        "collisions": count_runs(trajectory.collision),
    }


def _episodes(count: int) -> str:
    return f"{count} episode{'' if count == 1 else 's'}"
