"""Results of evaluations."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
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
    encounter_figures,
    endless_metrics,
    find_body_contacts,
    goal_metrics,
)
from rover_rl.algos.evaluation.tables import finite_row
from rover_rl.envs.config import EnvConfig, plain_env
from rover_rl.envs.row_robots import RowRobots
from rover_rl.rng import episode_keys, row_keys
from rover_rl.robots import Robot, get_robots
from rover_rl.sims.backends import name_of
from rover_rl.sims.free_space.fitting import RobotGroups
from rover_rl.worlds import World

WORST = 6  # number of worlds with the lowest success rates that are named and drawn


class _Results(ABC):
    """What the results of both modes have in common."""

    name: str
    trajectories: list[Trajectory]
    env: EnvConfig
    action_repeat: int
    imperfection: str

    @property
    def backend(self) -> str:
        """Name of the backend; ``"module:class"`` of a custom one that is given as an object."""
        return self.env.backend if isinstance(self.env.backend, str) else name_of(self.env.backend)

    @property
    @abstractmethod
    def _places(self) -> World | list[World]:
        """World of all episodes, or of each."""

    @property
    @abstractmethod
    def _first_seed(self) -> int:
        """Seed of the first episode."""

    @cached_property
    def robots(self) -> list[Robot]:
        """Robot of each episode."""
        keys = episode_keys(row_keys(self._first_seed, len(self.trajectories), torch.device("cpu")), 1)
        # All of them fit in the worlds of an evaluation.
        robots = RobotGroups(get_robots(self.env.robot)).robots
        return [*RowRobots(robots, keys, torch.tensor([[0, len(robots)]] * len(keys))).fleet]

    @cached_property
    def wall_contacts(self) -> list[Tensor]:
        """Whether the body touches an obstacle at rest at the start and after each step: bool ``[T + 1]`` each."""
        return find_body_contacts(self.trajectories, self._places, self.robots)

    @cached_property
    def contacts(self) -> list[Tensor]:
        """Whether the body touches an obstacle or a mover at the start and after each step: bool ``[T + 1]`` each."""
        return [t.touching(walls) for t, walls in zip(self.trajectories, self.wall_contacts, strict=True)]

    @property
    def _ends(self) -> list[dict[str, Any]]:
        return [_end(t, walls) for t, walls in zip(self.trajectories, self.wall_contacts, strict=True)]

    def _summary(self, mode: str, world: str, seed: int) -> dict[str, Any]:
        return {
            "policy": self.name,
            "backend": self.backend,
            "world": world,
            "mode": mode,
            "seed": seed,
            "action_repeat": self.action_repeat,
            "count": len(self.trajectories),
            "goals": sum(int(t.goal.sum()) for t in self.trajectories),
            "collisions": sum(count_runs(t.collision) for t in self.trajectories),
            **({"imperfection": self.imperfection} if self.imperfection else {}),
        }


@dataclass(frozen=True)
class Evaluation(_Results):
    """Results of a policy on episodes with one goal each.

    ``seconds`` is the time limit of an episode, s. Each action was held for ``action_repeat`` steps. ``imperfection``
    is the name of that of the sensors, empty if none was asked for.
    """

    name: str
    episodes: EpisodeSet
    action_repeat: int
    seconds: float
    trajectories: list[Trajectory]
    env: EnvConfig = field(default_factory=EnvConfig)
    imperfection: str = ""

    @property
    def endings(self) -> list[str]:
        """Ending of each episode: ``"goal"``, ``"time limit"`` or an early ending."""
        return [trajectory.ending for trajectory in self.trajectories]

    @property
    def steps(self) -> Tensor:
        """Number of steps of each episode, int64 ``[count]``."""
        return torch.tensor([*map(len, self.trajectories)])

    @property
    def paths(self) -> list[Tensor]:
        """Positions at the start and after each step: ``[T + 1, 2]`` each, m."""
        return [trajectory.path for trajectory in self.trajectories]

    @property
    def reached(self) -> Tensor:
        """Whether each episode reached its goal, bool ``[count]``."""
        return torch.tensor([ending == "goal" for ending in self.endings])

    @property
    def _places(self) -> list[World]:
        return self.episodes.worlds

    @property
    def _first_seed(self) -> int:
        return self.episodes.seed + self.episodes.offset

    @cached_property
    def metrics(self) -> dict[str, Estimate]:
        """Metrics, by name: see :mod:`rover_rl.algos.evaluation.metrics`."""
        return goal_metrics(self.trajectories, self.episodes.shortest, self.wall_contacts)

    @property
    def world_name(self) -> str:
        """Name of the world or of the range of worlds, as the user gave it."""
        return self.episodes.name

    @cached_property
    def by_world(self) -> list[dict[str, Any]]:
        """Results in each world, in the order of the pool.

        The keys are ``world`` (index in the pool), ``name``, ``count``, ``success_rate``, ``contact_free_success_rate``
        and ``mean_time_to_traverse`` (s, ``None`` if no goal was reached). A world with movers also has
        ``mover_contact_share``.
        """
        members: dict[int, list[int]] = {}
        for episode, index in enumerate(self.episodes.world_index.tolist()):
            members.setdefault(index, []).append(episode)
        return [self._in_world(index, members[index]) for index in sorted(members)]

    def _in_world(self, index: int, episodes: Sequence[int]) -> dict[str, Any]:
        reached = [episode for episode in episodes if self.trajectories[episode].ending == "goal"]
        clean = [episode for episode in reached if not self.contacts[episode].any()]
        seconds = [self.trajectories[episode].seconds for episode in reached]
        met = [one for episode in episodes if (one := self.trajectories[episode].encounters) is not None]
        touched = {"mover_contact_share": sum(bool(one.contact.any()) for one in met) / len(met)} if met else {}
        return {
            "world": index,
            "name": self.episodes.world_name(episodes[0]),
            "count": len(episodes),
            "success_rate": len(reached) / len(episodes),
            "contact_free_success_rate": len(clean) / len(episodes),
            "mean_time_to_traverse": round(sum(seconds) / len(seconds), 3) if seconds else None,
            **touched,
        }

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
    def goals_per_2000_steps(self) -> float:
        """Number of goals reached per 2,000 steps, the length of a full episode."""
        return int(self.reached.sum()) * EnvConfig.length / int(self.steps.sum())

    @property
    def title(self) -> str:
        """Title of a table with these results."""
        episodes, limit = self.episodes, f"one goal within {self.seconds:g} s"
        if not episodes.several_worlds:
            return f"{_count(len(episodes))} in {episodes.name}: {limit}"
        counts = {world["count"] for world in self.by_world}
        each = f"{_count(counts.pop())} in each" if len(counts) == 1 else _count(len(episodes))
        return f"{each} of {len(self.by_world)} worlds, {episodes.name}: {limit}"

    def summary(self) -> dict[str, Any]:
        """Returns policy, backend, world and counts as plain data."""
        return {**self._summary("one goal", self.world_name, self.episodes.seed), "time_limit": self.seconds}

    @property
    def _episodes(self) -> list[dict[str, Any]]:
        columns = (getattr(self.episodes, key).tolist() for key in ("start", "goal", "shortest"))
        return [
            {"start": start, "goal": goal, "shortest": shortest, "length": t.length, **end}
            for start, goal, shortest, t, end in zip(*columns, self.trajectories, self._ends, strict=True)
        ]

    def episode_rows(self) -> list[dict[str, Any]]:
        """Returns a row of plain values for each episode, as in ``evaluation.csv``."""
        rows = []
        for number, episode in enumerate(self._episodes):
            start = dict(zip(("start_x", "start_y", "start_yaw"), episode.pop("start"), strict=True))
            goal = dict(zip(("goal_x", "goal_y"), episode.pop("goal"), strict=True))
            row = _row(self, number, self.episodes.world_name(number))
            rows.append({**row, **start, **goal, **episode, "success": episode["ending"] == "goal"})
        return rows

    def to_json(self) -> dict[str, Any]:
        """Returns all results except the trajectories as plain data."""
        if not self.episodes.several_worlds:
            return {**_plain(self), "episodes": self._episodes}
        indices = self.episodes.world_index.tolist()
        episodes = [{"world": index, **row} for index, row in zip(indices, self._episodes, strict=True)]
        return {**_plain(self), "worlds": self.by_world, "episodes": episodes}


@dataclass(frozen=True)
class EndlessEvaluation(_Results):
    """Results of a policy in endless mode, in which each reached goal is followed by a new one, as in the original.

    ``length`` is the number of steps after which an episode ended, and ``jam`` whether a long collision ended one.
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
    imperfection: str = ""

    @property
    def _places(self) -> World:
        return self.world

    @property
    def _first_seed(self) -> int:
        return self.seed

    @cached_property
    def metrics(self) -> dict[str, Estimate]:
        """Metrics, by name: see :mod:`rover_rl.algos.evaluation.metrics`."""
        return endless_metrics(self.trajectories, self.wall_contacts)

    @property
    def title(self) -> str:
        """Title of a table with these results."""
        jam = "" if self.jam else ", without the jam ending"
        episodes = _count(len(self.trajectories))
        return f"{episodes} in {self.world_name}: endless goals, {self.length:,} steps each{jam}"

    def summary(self) -> dict[str, Any]:
        """Returns policy, backend, world and counts as plain data."""
        limit = self.length * self.trajectories[0].dt
        return {**self._summary("endless", self.world_name, self.seed), "time_limit": limit, "jam": self.jam}

    @property
    def _episodes(self) -> list[dict[str, Any]]:
        return [{"goals": int(t.goal.sum()), **end} for t, end in zip(self.trajectories, self._ends, strict=True)]

    def episode_rows(self) -> list[dict[str, Any]]:
        """Returns a row of plain values for each episode, as in ``evaluation.csv``."""
        return [{**_row(self, number, self.world_name), **row} for number, row in enumerate(self._episodes)]

    def to_json(self) -> dict[str, Any]:
        """Returns all results except the trajectories as plain data."""
        return {**_plain(self), "episodes": self._episodes}


def worst_worlds(evaluations: Sequence[Evaluation], count: int = WORST) -> list[int]:
    """Returns the indices of the worlds with the lowest mean success, then with most contacts, then slowest."""

    def merit(index: int) -> tuple[float, float, float]:
        results = [evaluation.by_world[index] for evaluation in evaluations]
        times = [-(result["mean_time_to_traverse"] or math.inf) for result in results]
        keys = ("success_rate", "contact_free_success_rate")
        success, clean = (sum(result[key] for result in results) for key in keys)
        return success, clean, sum(times)

    order = sorted(range(len(evaluations[0].by_world)), key=merit)
    return [evaluations[0].by_world[index]["world"] for index in order[:count]]


def _plain(evaluation: Evaluation | EndlessEvaluation) -> dict[str, Any]:
    return {
        **evaluation.summary(),
        "env": plain_env_or_none(evaluation.env),
        "metrics": plain_estimates(evaluation.metrics),
        "endings": dict(Counter(trajectory.ending for trajectory in evaluation.trajectories)),
    }


def _row(evaluation: Evaluation | EndlessEvaluation, episode: int, world: str) -> dict[str, Any]:
    summary = evaluation.summary()
    keys = ("policy", "backend", "imperfection", "mode", "seed", "action_repeat")
    shared = {key: summary[key] for key in keys if key in summary}
    return {**shared, "world": world, "episode": episode}


def plain_env_or_none(env: EnvConfig) -> dict[str, Any] | None:
    """Returns the settings as plain data, ``None`` if they contain objects that have no plain form."""
    try:
        return plain_env(env)
    except ValueError:
        return None


def plain_estimates(estimates: Mapping[str, Estimate]) -> dict[str, dict[str, float | None]]:
    """Returns estimates as plain data, with ``None`` for nan and infinity."""
    return {key: finite_row(vars(estimate)) for key, estimate in estimates.items()}


def _end(trajectory: Trajectory, walls: Tensor) -> dict[str, Any]:
    end = {
        "ending": trajectory.ending,
        "seconds": round(trajectory.seconds, 3),
        "contacts": count_runs(trajectory.touching(walls)),
        "collisions": count_runs(trajectory.collision),
    }
    if trajectory.encounters is None:
        return end
    figures = encounter_figures(trajectory)._asdict()
    return {**end, "wall_contacts": count_runs(walls), **{key: round(value, 3) for key, value in figures.items()}}


def _count(episodes: int) -> str:
    return f"{episodes} episode{'' if episodes == 1 else 's'}"
