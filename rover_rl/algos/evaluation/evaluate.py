"""Evaluation: policies drive fixed episodes, or endlessly as in the original, and are measured.

Example:
    >>> actor = Checkpoint.load("runs/ppo-maze").make_actor()
    >>> episodes = stored_episodes("maze")
    >>> print_table([evaluate(actor, episodes, name="PPO"), evaluate(None, episodes)])
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import TypeAlias

import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.evaluation.episodes import DEFAULT_SEED, EpisodeSet, draw_episodes
from rover_rl.algos.evaluation.metrics import TIME_LIMIT, Trajectory
from rover_rl.algos.evaluation.results import EndlessEvaluation, Evaluation
from rover_rl.algos.policy.baselines import RandomPolicy
from rover_rl.algos.policy.networks import single_threaded
from rover_rl.checks import MAX_COUNT, MAX_SECONDS, check_at_least
from rover_rl.envs import EnvConfig, RoverEnv, StepEvent
from rover_rl.envs.config import require_match
from rover_rl.sims.rotations import quaternion_to_euler
from rover_rl.sims.timing import CONTROL_DT
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
"""Endings of an episode before its time limit, by the event of its last step."""
_MIN_ROWS = 32
"""Least number of rows that a policy is called with: matrix products of few rows round differently."""


def evaluate(
    policy: Policy | None,
    episodes: EpisodeSet,
    *,
    name: str | None = None,
    action_repeat: int = 1,
    seconds: float = 60.0,
    rows: int = 32,
    env: EnvConfig | None = None,
) -> Evaluation:
    """Drives every episode once: one goal, within a time limit.

    An episode gives the same result to the last bit whatever ``rows`` is and whatever else is driven, if the policy
    treats rows independently. Policies with matrix products are called with at least 32 rows for that reason.

    Args:
        policy: a module from observation to action, used without exploration; ``None`` acts at random. It is called
            with at least 32 rows; the last row may be repeated to fill them up.
        episodes: episodes to drive.
        name: name of the policy, for tables and pictures.
        action_repeat: number of steps that each action is held for; 1 decides at 20 Hz.
        seconds: time limit of each episode.
        rows: number of rovers that drive at once; each takes the next episode when its own has ended.
        env: environment to drive in: robot, lidar, action, task, heading PID, randomization and simulator are used;
            ``None``: that of a checkpoint's policy, else the defaults.

    Raises:
        ValueError: for a number out of its range, or a policy that was made for another environment.
    """
    check_at_least(CONTROL_DT, MAX_SECONDS, seconds=seconds)
    check_at_least(1, MAX_COUNT, rows=rows, action_repeat=action_repeat)
    name = name or ("random" if policy is None else "policy")
    described = replace(
        environment_for(policy, env),
        world=episodes.world,
        num_envs=min(rows, len(episodes)),
        end_on_goal=True,
        seed=episodes.seed,
    )
    rovers = RoverEnv(**described.arguments())
    rovers.length = max(1, round(seconds / rovers.control_dt))
    policy = policy or RandomPolicy(episodes.seed)
    trajectories = _drive(rovers, policy, action_repeat, name, {"start": episodes.start, "goal": episodes.goal})
    return Evaluation(name, episodes, action_repeat, seconds, trajectories, replace(described, world=episodes.name))


def evaluate_endless(
    policy: Policy | None,
    world: str | World,
    *,
    name: str | None = None,
    rows: int = 32,
    seed: int = DEFAULT_SEED,
    jam: bool = True,
    steps: int = EnvConfig.length,
    action_repeat: int = 1,
    env: EnvConfig | None = None,
) -> EndlessEvaluation:
    """Drives the original's episodes: up to 2,000 steps, with a new goal whenever one is reached.

    Args:
        policy: as for :func:`evaluate`.
        world: world to drive in.
        name: name of the policy.
        rows: number of rovers, each of which drives one episode.
        seed: seed of the first episode; episode ``i`` is that of an environment seeded ``seed + i``.
        jam: whether a collision of more than 15 steps ends an episode, as in the contract. In the original it never
            does: its counter is never incremented.
        steps: number of steps after which an episode ends.
        action_repeat: number of steps that each action is held for.
        env: environment to drive in, as for :func:`evaluate`.

    Raises:
        ValueError: for a number out of its range, an unknown world, or a policy that was made for another environment.
    """
    check_at_least(1, MAX_COUNT, rows=rows, steps=steps, action_repeat=action_repeat)
    name = name or ("random" if policy is None else "policy")
    described, place = environment_for(policy, env), get_world(world)
    task = described.task if jam else replace(described.task, collision_window=steps)
    described = replace(described, world=place, num_envs=rows, length=steps, end_on_goal=False, seed=seed, task=task)
    trajectories = _drive(RoverEnv(**described.arguments()), policy or RandomPolicy(seed), action_repeat, name)
    world_name = world if isinstance(world, str) else place.name
    described = replace(described, world=world_name)
    return EndlessEvaluation(name, world_name, place, seed, action_repeat, jam, steps, trajectories, described)


def environment_for(policy: Policy | None, env: EnvConfig | None) -> EnvConfig:
    """The environment to drive in: see :func:`evaluate`.

    Raises:
        ValueError: if the policy was made for another one.
    """
    made_for: EnvConfig | None = getattr(policy, "made_for", None)
    if env is None:
        # By default policies are compared without randomization and in Bullet, whatever they were trained with.
        parts = made_for or EnvConfig()
        return EnvConfig(
            robot=parts.robot,
            lidar=parts.lidar,
            action=parts.action,
            task=parts.task,
            heading_gains=parts.heading_gains,
        )
    if made_for is not None:
        require_match(made_for, env)
    return replace(env, privileged=False)


@torch.no_grad()
@single_threaded()
def _drive(
    env: RoverEnv, policy: Policy, action_repeat: int, name: str, places: Mapping[str, Tensor] | None = None
) -> list[Trajectory]:
    """Drives episodes, and closes the environment. A rover takes the next episode when its own has ended.

    Args:
        env: the environment.
        policy: the policy.
        action_repeat: number of steps that each action is held for.
        name: name of the policy, for the progress bar.
        places: ``start [count, 3]`` and ``goal [count, 2]`` of every episode; ``None``: each rover drives one episode,
            with the start and goal that the environment draws.
    """
    check_at_least(1, MAX_COUNT, action_repeat=action_repeat)
    places = places or {}
    count = len(places["start"]) if places else env.num_envs
    log = _Recorder(count, env.length, env.control_dt)
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
            due = now["outcome", "steps"] % action_repeat == 0
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
            show(log.progress)
    return log.trajectories


def _decide(policy: Policy, observation: TensorDictBase) -> Tensor:
    """The policy's action ``[N, 2]``, computed on at least 32 rows, so that it rounds alike for any number."""
    rows = len(observation)
    filled = observation[torch.arange(max(rows, _MIN_ROWS)).clamp(max=rows - 1)]
    return policy(filled)["action"][:rows]


class _Recorder:
    """Records episodes step by step, in one tensor for all of them.

    Args:
        count: number of episodes.
        length: number of steps of the longest episode.
        dt: duration of a step, s.
    """

    def __init__(self, count: int, length: int, dt: float) -> None:
        self._dt = dt
        # Position (3), angles (3), collision, goal.
        self._records = torch.zeros(count, length + 1, 8)
        self._steps = torch.zeros(count, dtype=torch.int64)
        self._endings = [""] * count

    def add(self, env: RoverEnv, now: TensorDictBase, episode: Tensor, rows: Tensor) -> None:
        """Records the rovers of ``rows`` (bool ``[N]``), in the episode ``[N]`` that each drives."""
        outcome, rover = now["outcome"], env.rover_state
        events = (outcome["collision"], outcome["goal_reached"])
        record = torch.cat((rover.position, quaternion_to_euler(rover.orientation), *events), -1)
        steps = outcome["steps"].squeeze(-1)
        self._records[episode[rows], steps[rows]] = record[rows]
        self._steps[episode[rows]] = steps[rows]

    def end(self, now: TensorDictBase, episode: int) -> None:
        """Records the ending of an episode from its last step."""
        early = bool(now["terminated"])
        self._endings[episode] = ENDINGS[StepEvent(int(now["outcome", "phase"]))] if early else TIME_LIMIT

    @property
    def progress(self) -> float:
        """Fraction of the work that is done."""
        ended = torch.tensor([bool(ending) for ending in self._endings])
        return torch.where(ended, 1.0, self._steps / (self._records.shape[1] - 1)).mean().item()

    @property
    def trajectories(self) -> list[Trajectory]:
        """Trajectories of the episodes, in order."""
        recorded = zip(self._records, self._steps.tolist(), self._endings, strict=True)
        return [
            Trajectory(
                position=record[: steps + 1, :3],
                angles=record[: steps + 1, 3:6],
                collision=record[1 : steps + 1, 6].bool(),
                goal=record[1 : steps + 1, 7].bool(),
                ending=ending,
                dt=self._dt,
            )
            for record, steps, ending in recorded
        ]


@contextmanager
def _progress_bar(name: str) -> Iterator[Callable[[float], None]]:
    """Yields a function that shows the progress on a terminal. The bar disappears at the end."""
    columns = (TextColumn(name), BarColumn(20), TaskProgressColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, transient=True, disable=not Console().is_terminal) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda progress: bar.update(task, completed=progress)
