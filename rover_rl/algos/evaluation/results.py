"""Results of evaluations: a table of episodes, of which metrics, files and figures are columns."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rover_rl.algos.evaluation.episodes import EpisodeSet, read_episodes
from rover_rl.algos.evaluation.metrics import METRICS, Estimate, Row, compute_metrics, episode_row, finite_row
from rover_rl.algos.evaluation.trajectory import Trajectory, find_body_contacts
from rover_rl.envs.config import EnvConfig, Randomization, env_from_plain, plain_env
from rover_rl.envs.rows import drawn_lots
from rover_rl.rng import episode_keys, row_keys
from rover_rl.robots import Robot
from rover_rl.sims.backends import name_of
from rover_rl.sims.free_space.fitting import RobotGroups

FILE = "evaluation.json"  # name of the file in the folder of a run
WORST = 6  # number of worlds with the lowest success rates that are named and drawn
EPISODES_PER_PART = 32
"""Number of episodes that one process evaluates at a time. It does not depend on the number of cores, so that the
results of randomized environments do not, either."""
_OF_EPISODE = ("ending", "seconds", "contacts", "collisions")  # columns in files, for one goal and endless ones
_OF_MOVERS = ("wall_contacts", "mover_contacts", "run_into", "least_mover_distance")
_MOVER_SECONDS = ("risk_seconds", "intrusion_seconds", "frozen_seconds")  # with _OF_MOVERS, these have three digits
_TIME = "mean_time_to_traverse"
_OF_WORLD = ("success_rate", "contact_free_success_rate", _TIME, "mover_contact_share")  # metrics of each world


@dataclass(frozen=True)
class Evaluation:
    """Results of a policy on episodes with one goal each, or endless: a reached goal is followed by a new one."""

    name: str  #: Name of the policy.
    episodes: EpisodeSet  #: Starts and goals, in the order of the trajectories.
    action_repeat: int  #: Number of steps that each action was held for.
    seconds: float  #: Time limit of an episode, s.
    trajectories: list[Trajectory]
    env: EnvConfig = field(default_factory=EnvConfig)
    imperfection: str = ""  #: Name of that of the sensors; empty if none was asked for.
    jam: bool = True  #: Whether a long collision ended an endless episode.

    @property
    def endless(self) -> bool:
        return self.episodes.endless

    @property
    def backend(self) -> str:
        """Name of the simulator; ``"module:class"`` of a custom one that is given as an object."""
        return self.env.backend if isinstance(self.env.backend, str) else name_of(self.env.backend)

    @cached_property
    def robots(self) -> list[Robot]:
        first = self.episodes.seed + self.episodes.offset
        keys = episode_keys(row_keys(first, len(self.trajectories), torch.device("cpu")), 1)
        # All of them fit in the worlds of an evaluation.
        groups = RobotGroups(self.env.robot)
        choices = torch.tensor([[0, len(groups.lots)]] * len(keys))
        return [groups.robots[groups.lots[lot]] for lot in drawn_lots(choices, keys).tolist()]

    @cached_property
    def wall_contacts(self) -> list[Tensor]:
        """Whether the body touches an obstacle at rest at the start and after each step: bool ``[T + 1]`` each."""
        return find_body_contacts(self.trajectories, self.episodes.worlds, self.robots)

    @property
    def contacts(self) -> list[Tensor]:
        """Whether the body touches an obstacle or a mover at the start and after each step: bool ``[T + 1]`` each."""
        return [t.touching(walls) for t, walls in zip(self.trajectories, self.wall_contacts, strict=True)]

    @cached_property
    def table(self) -> list[Row]:
        pairs = zip(self.trajectories, self.wall_contacts, self.episodes.shortest.tolist(), strict=True)
        return [episode_row(*each) for each in pairs]

    @cached_property
    def metrics(self) -> dict[str, Estimate]:
        return compute_metrics(self.table, self.endless)

    @property
    def endings(self) -> list[str]:
        """Ending of each episode: ``"goal"``, ``"time limit"`` or an early ending."""
        return [trajectory.ending for trajectory in self.trajectories]

    @property
    def paths(self) -> list[Tensor]:
        return [trajectory.path for trajectory in self.trajectories]

    @property
    def reached(self) -> Tensor:
        return torch.tensor([ending == "goal" for ending in self.endings])

    @property
    def success_rate(self) -> float:
        return self.reached.double().mean().item()

    @cached_property
    def by_world(self) -> list[dict[str, Any]]:
        """Results in each world, in the order of the pool. ``mean_time_to_traverse`` (s) is ``None`` without goals."""
        results, indices = [], self.episodes.world_index
        for index in indices.unique().tolist():
            members = (indices == index).nonzero().squeeze(-1).tolist()
            rows = [self.table[episode] for episode in members]
            keys = _OF_WORLD if "mover_contacts" in rows[0] else _OF_WORLD[:-1]
            found = finite_row({key: METRICS[key].estimate(rows).value for key in keys})
            if (seconds := found[_TIME]) is not None:
                found[_TIME] = round(seconds, 3)
            head = {"world": index, "name": self.episodes.world_name(members[0]), "count": len(rows)}
            results.append(head | found)
        return results

    def select(self, indices: Sequence[int]) -> Evaluation:
        trajectories = [self.trajectories[index] for index in indices]
        return replace(self, episodes=self.episodes.select(indices), trajectories=trajectories)

    @property
    def title(self) -> str:
        episodes, count = self.episodes, len(self.episodes)
        several = f"{count} episode{'' if count == 1 else 's'}"
        if self.endless:
            jam, steps = "" if self.jam else ", without the jam ending", round(self.seconds / self.env.control_dt)
            return f"{several} in {episodes.name}: endless goals, {steps:,} steps each{jam}"
        limit = f"one goal within {self.seconds:g} s"
        if not episodes.several_worlds:
            return f"{several} in {episodes.name}: {limit}"
        counts = {world["count"] for world in self.by_world}
        each = "episode" if counts == {1} else "episodes"
        several = f"{counts.pop()} {each} in each" if len(counts) == 1 else several
        return f"{several} of {len(self.by_world)} worlds, {episodes.name}: {limit}"

    def summary(self) -> dict[str, Any]:
        return {
            "policy": self.name,
            "backend": self.backend,
            "world": self.episodes.name,
            "mode": "endless" if self.endless else "one goal",
            "seed": self.episodes.seed,
            "action_repeat": self.action_repeat,
            "count": len(self.trajectories),
            "goals": sum(row["goals"] for row in self.table),
            "collisions": sum(row["collisions"] for row in self.table),
            **({"imperfection": self.imperfection} if self.imperfection else {}),
            "time_limit": self.seconds,
            **({"jam": self.jam} if self.endless else {}),
        }

    def episode_rows(self) -> list[dict[str, Any]]:
        """A row of plain values for each episode, as in ``evaluation.csv``."""
        summary, rows, keys = self.summary(), [], ("policy", "backend", "imperfection", "mode", "seed", "action_repeat")
        head = {key: summary[key] for key in keys if key in summary}
        for number, episode in enumerate(self._episodes):
            place = (*episode.pop("start", ()), *episode.pop("goal", ()))
            named = dict(zip(("start_x", "start_y", "start_yaw", "goal_x", "goal_y"), place, strict=False))
            world = {"world": self.episodes.world_name(number), "episode": number}
            success = {} if self.endless else {"success": episode["ending"] == "goal"}
            rows.append({**head, **world, **named, **episode, **success})
        return rows

    def to_json(self) -> dict[str, Any]:
        """All results except the trajectories, as plain data."""
        found = self.summary() | {"env": plain_env_or_none(self.env), "metrics": plain_estimates(self.metrics)}
        found["endings"] = dict(Counter(self.endings))
        if not self.episodes.several_worlds:
            return {**found, "episodes": self._episodes}
        indices = self.episodes.world_index.tolist()
        episodes = [{"world": index, **row} for index, row in zip(indices, self._episodes, strict=True)]
        return {**found, "worlds": self.by_world, "episodes": episodes}

    @property
    def _episodes(self) -> list[dict[str, Any]]:
        keys, episodes = ("goals",) if self.endless else ("shortest", "length"), []
        for row, start, goal in zip(self.table, self.episodes.start, self.episodes.goal, strict=True):
            episode = {} if self.endless else {"start": start.tolist(), "goal": goal.tolist()}
            episode |= {key: row[key] for key in (*keys, *_OF_EPISODE)} | {"seconds": round(row["seconds"], 3)}
            met = (*_OF_MOVERS, *_MOVER_SECONDS) if "mover_contacts" in row else ()
            episodes.append(episode | {key: round(row[key], 3) for key in met})
        return episodes


def worst_worlds(evaluations: Sequence[Evaluation], count: int = WORST) -> list[int]:
    """Indices of the worlds with the lowest mean success, then with most contacts, then slowest."""

    def merit(results: Sequence[dict[str, Any]]) -> tuple[float, ...]:
        success, clean = (sum(result[key] for result in results) for key in _OF_WORLD[:2])
        return success, clean, sum(-(result[_TIME] or math.inf) for result in results)

    results = zip(*(evaluation.by_world for evaluation in evaluations), strict=True)
    return [of_policies[0]["world"] for of_policies in sorted(results, key=merit)[:count]]


def plain_env_or_none(env: EnvConfig) -> dict[str, Any] | None:
    """The settings as plain data, ``None`` if they contain objects that have no plain form."""
    try:
        return plain_env(env)
    except ValueError:
        return None


def plain_estimates(estimates: Mapping[str, Estimate]) -> dict[str, dict[str, float | None]]:
    return {key: finite_row(vars(estimate)) for key, estimate in estimates.items()}


@dataclass(frozen=True)
class StoredEvaluation:
    """An evaluation with one goal per episode, as ``evaluation.json`` holds it: time limit and durations are in s."""

    policy: str
    episodes: EpisodeSet
    action_repeat: int
    seconds: float
    env: EnvConfig
    endings: list[str]
    durations: list[float]

    @property
    def failures(self) -> list[int]:
        return [index for index, ending in enumerate(self.endings) if ending != "goal"]

    def telling(self, worst: int, good: int) -> list[int]:
        """The ``worst`` episodes, failures or else those that took longest, and ``good`` ones of usual time."""
        failed, by_time = self.failures, sorted(range(len(self.endings)), key=lambda index: -self.durations[index])
        slowest = [index for index in by_time if index not in failed]
        usual = slowest[max(0, worst - len(failed)) :]
        middle = max(0, (len(usual) - good) // 2)
        return [*failed, *slowest][:worst] + usual[middle : middle + good]

    def to_drive(self, episode: int) -> EpisodeSet:
        """Episodes to drive for the same drive as in the evaluation: if it is random, with those that were its part."""
        if not 0 <= episode < len(self.episodes):
            raise ValueError(f"episode must be between 0 and {len(self.episodes) - 1}, got {episode}")
        exact = self.env.randomization == Randomization() and self.env.pose.source in ("truth", "odometry")
        size = 1 if exact else EPISODES_PER_PART
        begin = episode // size * size
        return self.episodes.part(begin, begin + size).with_used_worlds()


def read_evaluation(path: Path, policy: str, world: str | None = None, backend: str | None = None) -> StoredEvaluation:
    """Reads the first evaluation of a policy from a file, or from ``evaluation.json`` in a folder.

    ``world`` (or a range) and ``backend`` are names; ``None``: any. Raises ``ValueError`` if the file holds no such
    evaluation, ``FileNotFoundError`` if there is none.
    """
    path = path / FILE if path.is_dir() else path
    try:
        entries = json.loads(path.read_text())
        driven = [entry for entry in entries if entry["mode"] == "one goal" and entry["backend"] != "ros2"]
        wanted = {"policy": policy, "world": world, "backend": backend}
        given = {key: value for key, value in wanted.items() if value is not None}
        found = [entry for entry in driven if all(entry[key] == value for key, value in given.items())]
        if found:
            return _stored(found[0])
        held = sorted({", ".join(entry[key] for key in given) for entry in driven})
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is no evaluation of rover-rl evaluate") from error
    raise ValueError(f"{path} has no evaluation of {', '.join(given.values())}; it has {'; '.join(held) or 'none'}")


def _stored(entry: Mapping[str, Any]) -> StoredEvaluation:
    rows, world = entry["episodes"], entry["world"]
    episodes = read_episodes(world, entry["seed"], rows)
    env = EnvConfig(backend=entry["backend"]) if entry["env"] is None else env_from_plain(entry["env"], FILE)
    endings, durations = ([row[key] for row in rows] for key in ("ending", "seconds"))
    driven = entry["action_repeat"], entry["time_limit"], replace(env, world=world)
    return StoredEvaluation(entry["policy"], episodes, *driven, endings, durations)
