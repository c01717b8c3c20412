"""Evaluation: a policy drives a fixed set of starts and goals, beside a policy that acts at random.

Example:
    >>> episodes = draw_episodes("maze", count=64)
    >>> actor = Checkpoint.load("runs/ppo-maze/checkpoint.pt").make_actor()
    >>> print_table([evaluate(actor, episodes, name="trained"), evaluate(None, episodes)])
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import torch
from rich.console import Console
from rich.table import Table
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, RandomPolicy, set_exploration_type

from rover_rl.algos.action_repeat import ActionRepeat
from rover_rl.algos.config import SECONDS_PER_STEP
from rover_rl.algos.policy import single_threaded
from rover_rl.algos.progress import EPISODE_STEPS
from rover_rl.algos.runs import write_json
from rover_rl.envs import Phase, RoverEnv, TaskConfig
from rover_rl.envs.placement import Placement
from rover_rl.envs.rng import episode_keys, row_keys
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import World, get_world

Policy: TypeAlias = Callable[[TensorDictBase], TensorDictBase]

ENDINGS = {
    Phase.GOAL: "goal",
    Phase.FLIP: "flipped",
    Phase.JAM: "jammed",
    Phase.OUT_OF_BOUNDS: "out of bounds",
    Phase.STUCK: "stuck",
}
"""How an episode can end, by the phase of its last step; any other phase: ``"time limit"``."""
DEFAULT_SEED = 20_000


@dataclass(frozen=True)
class EpisodeSet:
    """Starts and goals to evaluate on.

    Attributes:
        world: where they lie.
        seed: they were drawn from.
        start: poses ``[count, 3]`` (x, y in m, yaw in rad).
        goal: ``[count, 2]``, m.
    """

    world: World
    seed: int
    start: Tensor
    goal: Tensor


@dataclass(frozen=True)
class Evaluation:
    """How a policy fared.

    Attributes:
        name: of the policy.
        episodes: what it drove.
        repeat: steps that each action was held for.
        seconds: that an episode could last.
        endings: how each episode ended: a value of :data:`ENDINGS`, or ``"time limit"``.
        steps: each episode took, int64 ``[count]``.
        paths: where each rover was, from start to end: ``[points, 2]`` each, m.
    """

    name: str
    episodes: EpisodeSet
    repeat: int
    seconds: float
    endings: list[str]
    steps: Tensor
    paths: list[Tensor]

    @property
    def reached(self) -> Tensor:
        """Which episodes reached their goal, bool ``[count]``."""
        return torch.tensor([ending == "goal" for ending in self.endings])

    @property
    def success_rate(self) -> float:
        """Share of episodes that reached their goal."""
        return self.reached.double().mean().item()

    @property
    def interval(self) -> tuple[float, float]:
        """Where the true success rate lies, with 95 % confidence."""
        return wilson_interval(int(self.reached.sum()), len(self.endings))

    @property
    def mean_time(self) -> float:
        """Seconds to the goal, where it was reached; nan if it never was."""
        return self.steps[self.reached].double().mean().item() * SECONDS_PER_STEP

    @property
    def goals_per_2000_steps(self) -> float:
        """Goals reached in as many steps as a full episode has."""
        return int(self.reached.sum()) * EPISODE_STEPS / int(self.steps.sum())

    def to_json(self) -> dict[str, Any]:
        """Everything but the paths, as plain data."""
        rows = zip(
            self.episodes.start.tolist(),
            self.episodes.goal.tolist(),
            self.endings,
            self.steps.tolist(),
            strict=True,
        )
        return {
            "policy": self.name,
            "world": self.episodes.world.name,
            "seed": self.episodes.seed,
            "repeat": self.repeat,
            "time_limit": self.seconds,
            "count": len(self.endings),
            "success_rate": self.success_rate,
            "success_interval": self.interval,
            "mean_time": None if math.isnan(self.mean_time) else self.mean_time,
            "goals_per_2000_steps": self.goals_per_2000_steps,
            "endings": dict(Counter(self.endings)),
            "episodes": [
                {"start": start, "goal": goal, "ending": ending, "seconds": steps * SECONDS_PER_STEP}
                for start, goal, ending, steps in rows
            ],
        }


def draw_episodes(world: str | World, count: int = 64, seed: int = DEFAULT_SEED) -> EpisodeSet:
    """Draws starts and goals as the environment does: the same seed gives the same ones.

    Raises:
        ValueError: for an unknown world, or a ``count`` below 1.
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    place, device = get_world(world), torch.device("cpu")
    placement = Placement([place] * count, get_robot("rover_zero"), TaskConfig().min_goal_distance, device)
    keys = episode_keys(row_keys(seed, count, device), torch.ones(count, 1, dtype=torch.int64))
    start = placement.draw_start(keys)
    goal = placement.draw_goal(keys, torch.zeros_like(keys), start[:, :2])
    return EpisodeSet(place, seed, start, goal)


@torch.no_grad()
@single_threaded()
def evaluate(
    policy: Policy | None,
    episodes: EpisodeSet,
    *,
    name: str | None = None,
    repeat: int = 1,
    seconds: float = 60.0,
    lidar_points: int = 32,
) -> Evaluation:
    """Drives every episode once, all at the same time: one goal, within a time limit.

    Args:
        policy: a module from observation to action, taken without exploration; ``None`` acts at random.
        episodes: to drive.
        name: of the policy, for tables and pictures.
        repeat: steps that each action is held for; 1 decides at 20 Hz.
        seconds: for each episode.
        lidar_points: readings that the policy sees.

    Raises:
        ValueError: for a ``repeat`` or a time below one step.
    """
    base = RoverEnv(
        world_n=episodes.world,
        num_envs=len(episodes.start),
        length=round(seconds / SECONDS_PER_STEP),
        lidar_points=lidar_points,
        end_on_goal=True,
        seed=episodes.seed,
    )
    env = base.append_transform(ActionRepeat(repeat))
    # The random policy draws from torch's generator; one that does not explore draws nothing.
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.random.fork_rng(devices=[]):
        torch.manual_seed(episodes.seed)
        rollout = env.rollout(
            base.length,
            policy or RandomPolicy(env.action_spec),
            tensordict=env.reset(start=episodes.start, goal=episodes.goal),
            auto_reset=False,
            break_when_all_done=True,
        )
    env.close()
    name = name or ("random" if policy is None else "policy")
    outcome = rollout["next", "outcome"]
    steps = outcome["steps"][:, -1, 0]
    return Evaluation(
        name=name,
        episodes=episodes,
        repeat=repeat,
        seconds=seconds,
        # Rows that have ended keep their last decision to the end of the rollout.
        endings=[ENDINGS.get(Phase(phase), "time limit") for phase in outcome["phase"][:, -1, 0].tolist()],
        steps=steps,
        paths=_paths(rollout, (steps + repeat - 1) // repeat),
    )


def _paths(rollout: TensorDictBase, decisions: Tensor) -> list[Tensor]:
    """Positions at the start and after each of ``decisions [count]``, from a rollout ``[count, T]``."""
    positions = torch.cat((rollout["pose"][:, :1, :2], rollout["next", "pose"][..., :2]), 1)
    return [path[: count + 1] for path, count in zip(positions, decisions.tolist(), strict=True)]


def wilson_interval(successes: int, count: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson's score interval of a share: where it lies with 95 % confidence, for ``z`` of 1.96.

    Example:
        >>> [round(limit, 3) for limit in wilson_interval(9, 10)]
        [0.596, 0.982]
    """
    share = successes / count
    spread = z**2 / count
    centre = share + spread / 2
    margin = z * math.sqrt((share * (1 - share) + spread / 4) / count)
    return max(0.0, (centre - margin) / (1 + spread)), min(1.0, (centre + margin) / (1 + spread))


def print_table(evaluations: Sequence[Evaluation], console: Console | None = None) -> None:
    """Prints policies beside one another."""
    first = evaluations[0]
    world = first.episodes.world.name
    table = Table(title=f"{len(first.endings)} episodes in {world}: one goal within {first.seconds:g} s")
    for heading in ("policy", "success", "95 % interval", "time to goal"):
        table.add_column(heading, justify="left" if heading == "policy" else "right")
    kinds = Counter(ending for evaluation in evaluations for ending in evaluation.endings if ending != "goal")
    for kind, _ in kinds.most_common():
        table.add_column(kind, justify="right")
    for e in evaluations:
        low, high = e.interval
        time = "-" if math.isnan(e.mean_time) else f"{e.mean_time:.1f} s"
        counts, total = Counter(e.endings), len(e.endings)
        shares = [f"{counts[kind] / total:.0%}" for kind, _ in kinds.most_common()]
        table.add_row(e.name, f"{e.success_rate:.1%}", f"{low:.0%} to {high:.0%}", time, *shares)
    (console or Console()).print(table)


def write_evaluation(path: Path, evaluations: Sequence[Evaluation]) -> None:
    """Writes policies' results as JSON."""
    write_json(path, [evaluation.to_json() for evaluation in evaluations])
