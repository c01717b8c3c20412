"""Evaluation: policies drive fixed episodes, or without end as in the original, and are measured.

Example:
    >>> actor = Checkpoint.load("runs/ppo-maze").make_actor()
    >>> episodes = stored_episodes("maze")
    >>> print_table([evaluate(actor, episodes, name="PPO"), evaluate(None, episodes)])
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.config import SECONDS_PER_STEP
from rover_rl.algos.evaluation.episodes import DEFAULT_SEED, EpisodeSet, draw_episodes
from rover_rl.algos.evaluation.metrics import (
    TIME_LIMIT,
    Estimate,
    Trajectory,
    count_runs,
    endless_metrics,
    goal_metrics,
)
from rover_rl.algos.policy.baselines import RandomPolicy
from rover_rl.algos.policy.networks import single_threaded
from rover_rl.algos.train.progress import EPISODE_STEPS
from rover_rl.checks import MAX_COUNT, MAX_SECONDS, check_at_least
from rover_rl.envs import RoverEnv, StepEvent, TaskConfig
from rover_rl.sims import BackendLike
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import World, get_world

__all__ = [
    "ENDINGS",
    "EndlessEvaluation",
    "EpisodeSet",
    "Evaluation",
    "Policy",
    "draw_episodes",
    "evaluate",
    "evaluate_endless",
]

Policy: TypeAlias = Callable[[TensorDictBase], TensorDictBase]

ENDINGS = {
    StepEvent.INVALID_ACTION: "invalid action",
    StepEvent.FLIP: "flipped",
    StepEvent.JAM: "jammed",
    StepEvent.OUT_OF_BOUNDS: "out of bounds",
    StepEvent.STUCK: "stuck",
    StepEvent.GOAL: "goal",
}
"""How an episode can end before its time, by the phase of its last step."""
_LEAST_ROWS = 32
"""Rows that a policy is given at least: matrix products of few rows round differently."""


@dataclass(frozen=True)
class Evaluation:
    """How a policy fared on episodes with one goal each.

    Attributes:
        name: of the policy.
        episodes: what it drove.
        repeat: steps that each action was held for.
        seconds: that an episode could last.
        trajectories: what was recorded of each episode.
    """

    name: str
    episodes: EpisodeSet
    repeat: int
    seconds: float
    trajectories: list[Trajectory]

    @property
    def endings(self) -> list[str]:
        """How each episode ended: ``"goal"``, ``"time limit"``, or the kind of its early ending."""
        return [trajectory.ending for trajectory in self.trajectories]

    @property
    def steps(self) -> Tensor:
        """Each episode took, int64 ``[count]``."""
        return torch.tensor([len(trajectory) for trajectory in self.trajectories])

    @property
    def paths(self) -> list[Tensor]:
        """Where each rover was, at the start and after each step: ``[T + 1, 2]`` each, m."""
        return [trajectory.path for trajectory in self.trajectories]

    @property
    def reached(self) -> Tensor:
        """Which episodes reached their goal, bool ``[count]``."""
        return torch.tensor([ending == "goal" for ending in self.endings])

    @cached_property
    def metrics(self) -> dict[str, Estimate]:
        """Everything measured, by name: see :mod:`rover_rl.algos.evaluation.metrics`."""
        return goal_metrics(
            self.trajectories, self.episodes.shortest, self.episodes.world, robot=get_robot("rover_zero")
        )

    @property
    def success_rate(self) -> float:
        """Share of episodes that reached their goal."""
        return self.reached.double().mean().item()

    @property
    def interval(self) -> tuple[float, float]:
        """Where the true success rate lies, with 95 % confidence."""
        estimate = self.metrics["success_rate"]
        return estimate.low, estimate.high

    @property
    def mean_time(self) -> float:
        """Seconds to the goal, where it was reached; nan if it never was."""
        return self.metrics["mean_time_to_traverse"].value

    @property
    def goals_per_2000_steps(self) -> float:
        """Goals reached in as many steps as a full episode has."""
        return int(self.reached.sum()) * EPISODE_STEPS / int(self.steps.sum())

    @property
    def title(self) -> str:
        """What was driven, for a table of it."""
        return f"{len(self.episodes)} episodes in {self.episodes.name}: one goal within {self.seconds:g} s"

    def summary(self) -> dict[str, Any]:
        """What was driven, as plain data."""
        episodes = self.episodes
        shared = _summary(self.name, episodes.name, "one goal", episodes.seed, self.repeat, self.trajectories)
        return shared | {"time_limit": self.seconds}

    def to_json(self) -> dict[str, Any]:
        """Everything but the trajectories, as plain data."""
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
    """How a policy fared where goals keep coming, as in the original's episodes.

    Attributes:
        name: of the policy.
        world_name: of the world as it was asked for.
        world: where it drove.
        seed: of the first episode.
        repeat: steps that each action was held for.
        jam: whether a long collision ended an episode.
        length: steps that an episode could last.
        trajectories: what was recorded of each episode.
    """

    name: str
    world_name: str
    world: World
    seed: int
    repeat: int
    jam: bool
    length: int
    trajectories: list[Trajectory]

    @cached_property
    def metrics(self) -> dict[str, Estimate]:
        """Everything measured, by name: see :mod:`rover_rl.algos.evaluation.metrics`."""
        return endless_metrics(self.trajectories, self.world, robot=get_robot("rover_zero"))

    @property
    def title(self) -> str:
        """What was driven, for a table of it."""
        count, limit = len(self.trajectories), f"{self.length:,} steps"
        jam = "" if self.jam else ", without the jam ending"
        return f"{count} episodes in {self.world_name}: goals without end, {limit} each{jam}"

    def summary(self) -> dict[str, Any]:
        """What was driven, as plain data."""
        shared = _summary(self.name, self.world_name, "endless", self.seed, self.repeat, self.trajectories)
        return shared | {"time_limit": self.length * SECONDS_PER_STEP, "jam": self.jam}

    def to_json(self) -> dict[str, Any]:
        """Everything but the trajectories, as plain data."""
        episodes = [{"goals": int(t.goal.sum()), **_episode(t)} for t in self.trajectories]
        return {**_results(self), "episodes": episodes}


def _summary(
    name: str, world: str, mode: str, seed: int, repeat: int, trajectories: Sequence[Trajectory]
) -> dict[str, Any]:
    return {
        "policy": name,
        "world": world,
        "mode": mode,
        "seed": seed,
        "repeat": repeat,
        "count": len(trajectories),
        "goals": sum(int(t.goal.sum()) for t in trajectories),
        "collisions": sum(count_runs(t.collision) for t in trajectories),
    }


def _results(evaluation: Evaluation | EndlessEvaluation) -> dict[str, Any]:
    metrics = {
        key: {field: number if math.isfinite(number) else None for field, number in vars(estimate).items()}
        for key, estimate in evaluation.metrics.items()
    }
    endings = Counter(trajectory.ending for trajectory in evaluation.trajectories)
    return {**evaluation.summary(), "metrics": metrics, "endings": dict(endings)}


def _episode(trajectory: Trajectory) -> dict[str, Any]:
    return {"ending": trajectory.ending, "seconds": round(trajectory.seconds, 3)}


def evaluate(
    policy: Policy | None,
    episodes: EpisodeSet,
    *,
    name: str | None = None,
    repeat: int = 1,
    seconds: float = 60.0,
    rows: int = 32,
    lidar_points: int = 32,
    task: TaskConfig | None = None,
    backend: BackendLike = "bullet",
    physics: str | None = None,
) -> Evaluation:
    """Drives every episode once: one goal, within a time limit.

    An episode comes out the same to the last bit whatever ``rows`` is and whatever else is driven, for policies that
    treat rows apart; those with matrix products are held to that by never being given few rows.

    Args:
        policy: a module from observation to action, taken without exploration; ``None`` acts at random. It is called
            on 32 rows or more, of which the last may be repeated to fill up.
        episodes: to drive.
        name: of the policy, for tables and pictures.
        repeat: steps that each action is held for; 1 decides at 20 Hz.
        seconds: for each episode.
        rows: rovers that drive at once, each the next episode when its own has ended.
        lidar_points: readings that the policy sees.
        task: thresholds of the task.
        backend: what moves the rovers.
        physics: preset of a backend given by its name.

    Raises:
        ValueError: for ``repeat`` or ``rows`` below 1, or a time below one step.
    """
    check_at_least(SECONDS_PER_STEP, MAX_SECONDS, seconds=seconds)
    check_at_least(1, MAX_COUNT, rows=rows)
    name = name or ("random" if policy is None else "policy")
    env = RoverEnv(
        world_n=episodes.world,
        num_envs=min(rows, len(episodes)),
        length=round(seconds / SECONDS_PER_STEP),
        lidar_points=lidar_points,
        end_on_goal=True,
        seed=episodes.seed,
        task=task,
        backend=backend,
        physics=physics,
    )
    policy = policy or RandomPolicy(episodes.seed)
    trajectories = _drive(env, policy, repeat, name, {"start": episodes.start, "goal": episodes.goal})
    return Evaluation(name, episodes, repeat, seconds, trajectories)


def evaluate_endless(
    policy: Policy | None,
    world: str | World,
    *,
    name: str | None = None,
    rows: int = 32,
    seed: int = DEFAULT_SEED,
    jam: bool = True,
    steps: int = EPISODE_STEPS,
    repeat: int = 1,
    lidar_points: int = 32,
    task: TaskConfig | None = None,
    backend: BackendLike = "bullet",
    physics: str | None = None,
) -> EndlessEvaluation:
    """Drives the original's episodes: up to 2,000 steps, with a new goal whenever one is reached.

    Args:
        policy: as for :func:`evaluate`.
        world: where.
        name: of the policy.
        rows: rovers, each of which drives one episode.
        seed: of the first episode; episode ``i`` is that of an environment seeded ``seed + i``.
        jam: whether a collision of more than 15 steps ends an episode, as the contract has it. In the original it never
            does: its counter is never incremented.
        steps: that an episode lasts at most.
        repeat: steps that each action is held for.
        lidar_points: readings that the policy sees.
        task: thresholds of the task.
        backend: what moves the rovers.
        physics: preset of a backend given by its name.

    Raises:
        ValueError: for ``repeat``, ``rows`` or ``steps`` below 1, or an unknown world.
    """
    check_at_least(1, MAX_COUNT, rows=rows, steps=steps)
    name = name or ("random" if policy is None else "policy")
    task = task or TaskConfig()
    place = get_world(world)
    env = RoverEnv(
        world_n=place,
        num_envs=rows,
        length=steps,
        lidar_points=lidar_points,
        seed=seed,
        task=task if jam else replace(task, collision_window=steps),
        backend=backend,
        physics=physics,
    )
    trajectories = _drive(env, policy or RandomPolicy(seed), repeat, name)
    world_name = world if isinstance(world, str) else place.name
    return EndlessEvaluation(name, world_name, place, seed, repeat, jam, steps, trajectories)


@torch.no_grad()
@single_threaded()
def _drive(
    env: RoverEnv, policy: Policy, repeat: int, name: str, places: Mapping[str, Tensor] | None = None
) -> list[Trajectory]:
    """Drives episodes, and closes the environment: a rover takes the next episode when its own has ended.

    Args:
        env: the rovers.
        policy: decides.
        repeat: steps that each action is held for.
        name: of the policy, for the progress bar.
        places: ``start [count, 3]`` and ``goal [count, 2]`` of every episode; ``None``: each rover drives one, as the
            environment places it.
    """
    check_at_least(1, MAX_COUNT, repeat=repeat)
    places = places or {}
    count = len(places["start"]) if places else env.num_envs
    log = _Log(count, env.length)
    waiting = iter(range(env.num_envs, count))
    episode = torch.arange(env.num_envs)
    driving = torch.ones(env.num_envs, dtype=torch.bool)
    action = torch.zeros(env.num_envs, 2)

    def placed() -> dict[str, Tensor]:
        return {key: values[episode] for key, values in places.items()}

    with closing(env), _progress_bar(name) as show, set_exploration_type(ExplorationType.DETERMINISTIC):
        now = env.reset(**placed())
        log.add(env, now, episode, driving)
        while driving.any():
            due = now["outcome", "steps"] % repeat == 0
            action = torch.where(due, _decide(policy, now.set("episode", episode[:, None])), action)
            now = env.step(now.set("action", action).set("_step", driving))["next"]
            log.add(env, now, episode, driving)
            again = driving & now["done"].squeeze(-1)
            for row in again.nonzero().squeeze(-1).tolist():
                log.end(now[row], int(episode[row]))
                follower = next(waiting, None)
                driving[row] = again[row] = follower is not None
                episode[row] = episode[row] if follower is None else follower
            if again.any():
                now = env.reset(now.set("_reset", again[:, None]), **placed())
                log.add(env, now, episode, again)
            show(log.share)
    return log.trajectories


def _decide(policy: Policy, observation: TensorDictBase) -> Tensor:
    """The policy's action ``[N, 2]``, computed on 32 rows or more, which all round alike."""
    rows = len(observation)
    filled = observation[torch.arange(max(rows, _LEAST_ROWS)).clamp(max=rows - 1)]
    return policy(filled)["action"][:rows]


class _Log:
    """What happens in episodes, step by step, in one tensor for all of them.

    Args:
        count: episodes.
        length: steps of the longest.
    """

    def __init__(self, count: int, length: int) -> None:
        # Position (3), angles (3), collision, goal.
        self._records = torch.zeros(count, length + 1, 8)
        self._steps = torch.zeros(count, dtype=torch.int64)
        self._endings = [""] * count

    def add(self, env: RoverEnv, now: TensorDictBase, episode: Tensor, rows: Tensor) -> None:
        """Notes where the rovers of ``rows`` (bool ``[N]``) are, in the episode ``[N]`` that each drives."""
        pitch, roll, yaw = now["imu"].split(1, -1)
        outcome = now["outcome"]
        events = (outcome["collision"], outcome["goal_reached"])
        record = torch.cat((env.rover_state.position, roll, pitch, yaw, *events), -1)
        steps = outcome["steps"].squeeze(-1)
        self._records[episode[rows], steps[rows]] = record[rows]
        self._steps[episode[rows]] = steps[rows]

    def end(self, now: TensorDictBase, episode: int) -> None:
        """Notes how an episode ended, from what its rover saw last."""
        early = bool(now["terminated"])
        self._endings[episode] = ENDINGS[StepEvent(int(now["outcome", "phase"]))] if early else TIME_LIMIT

    @property
    def share(self) -> float:
        """Of all episodes that is done."""
        ended = torch.tensor([bool(ending) for ending in self._endings])
        return torch.where(ended, 1.0, self._steps / (self._records.shape[1] - 1)).mean().item()

    @property
    def trajectories(self) -> list[Trajectory]:
        """The episodes, in order."""
        recorded = zip(self._records, self._steps.tolist(), self._endings, strict=True)
        return [
            Trajectory(
                position=record[: steps + 1, :3],
                angles=record[: steps + 1, 3:6],
                collision=record[1 : steps + 1, 6].bool(),
                goal=record[1 : steps + 1, 7].bool(),
                ending=ending,
            )
            for record, steps, ending in recorded
        ]


@contextmanager
def _progress_bar(name: str) -> Iterator[Callable[[float], None]]:
    """A function that shows the share done, on a terminal; nothing is left of it in the end."""
    columns = (TextColumn(name), BarColumn(20), TaskProgressColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, transient=True, disable=not Console().is_terminal) as progress:
        task = progress.add_task("", total=1.0)
        yield lambda share: progress.update(task, completed=share)
