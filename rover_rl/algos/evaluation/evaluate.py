"""Evaluation of policies on fixed episodes, or in endless mode as in the original environment.

Example:
    >>> actor = Checkpoint.load("runs/ppo-moon").make_actor()
    >>> episodes = stored_episodes("maze").first(4)
    >>> print_table([evaluate(actor, episodes, name="PPO", seconds=5), evaluate(None, episodes, seconds=5)])
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from typing import TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.evaluation.cores import over_cores
from rover_rl.algos.evaluation.episodes import DEFAULT_SEED, EpisodeSet, draw_episodes
from rover_rl.algos.evaluation.metrics import TIME_LIMIT, Trajectory
from rover_rl.algos.evaluation.results import EndlessEvaluation, Evaluation
from rover_rl.algos.policy.baselines import RandomPolicy
from rover_rl.algos.policy.networks import single_threaded
from rover_rl.algos.policy.runner import Policy, PolicyRunner, default_action_repeat
from rover_rl.checks import MAX_COUNT, MAX_SECONDS, check_at_least
from rover_rl.envs import EnvConfig, RoverEnv, StepEvent
from rover_rl.envs.config import require_match
from rover_rl.progress import ProgressDisplay
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

ENDINGS = {
    StepEvent.INVALID_ACTION: "invalid action",
    StepEvent.FLIP: "flipped",
    StepEvent.JAM: "jammed",
    StepEvent.OUT_OF_BOUNDS: "out of bounds",
    StepEvent.STUCK: "stuck",
    StepEvent.GOAL: "goal",
}
"""Endings of an episode before its time limit, by the event of its last step."""
Watcher: TypeAlias = Callable[[RoverEnv, Tensor, Tensor], None]
"""Function that watches an evaluation: see :func:`evaluate`."""
_MIN_ROWS = 32
"""Smallest number of rows that a policy is called with: matrix products of few rows round differently."""


def evaluate(
    policy: Policy | None,
    episodes: EpisodeSet,
    *,
    name: str | None = None,
    action_repeat: int | None = None,
    seconds: float = 60.0,
    rows: int = 32,
    env: EnvConfig | None = None,
    watch: Watcher | None = None,
) -> Evaluation:
    """Evaluates a policy on episodes with one goal each and a time limit.

    If the policy treats rows independently, the result of an episode is bit-identical for any number of ``rows`` and
    any other episodes. Matrix products of few rows round differently, so the policy is called with at least 32 rows.

    Each rover stays in a world, so that episodes may be in several worlds in any simulator.

    With ``env.agents``, the rovers of that many consecutive episodes drive at once in the same world; draw such
    episodes with ``draw_episodes(..., agents=...)``. A rover whose episode has ended stays where it is until those of
    the others have. All episodes are driven at once then, whatever ``rows`` is.

    Args:
        policy: module that maps observations to actions, used without exploration; ``None`` acts at random. It is
            called with at least 32 rows; copies of the last row fill them up.
        episodes: episodes to drive.
        name: name of the policy, for tables and plots.
        action_repeat: number of steps that each action is held for; 1 decides at 20 Hz. ``None``: 1, and for a policy
            with memory the number in training.
        seconds: time limit of each episode, s.
        rows: number of rovers that drive at once; each takes the next episode in its world when its own has ended.
        env: environment to drive in, of which robot, lidar, action, task, heading PID, randomization and simulator
            are used; ``None``: the environment that the policy was made for, in Bullet and without randomization, else
            the defaults.
        watch: function that is called at the start and after each step of the episodes, with the environment, the
            index of each rover's episode, int64 ``[N]``, and the rovers that it concerns, bool ``[N]``.

    Raises:
        ValueError: for a number out of range, a policy that was made for another environment, or episodes that are not
            in groups of ``env.agents`` in the same world.
    """
    action_repeat = default_action_repeat(policy, action_repeat)
    check_options(rows=rows, seconds=seconds, action_repeat=action_repeat)
    name = name or ("random" if policy is None else "policy")
    env_config = environment_for(policy, env)
    if env_config.agents > 1:
        _check_groups(episodes, env_config.agents)
        rows = len(episodes)
    env_config = replace(env_config, num_envs=min(rows, len(episodes)), end_on_goal=True)
    policy = policy or RandomPolicy(episodes.seed)

    def drive(part: EpisodeSet) -> list[Trajectory]:
        return _drive_episodes(policy, part, env_config, action_repeat, seconds, name, watch)

    driven = over_cores(drive, _with_few_worlds(episodes, rows), name, workers=1)
    env_config = replace(env_config, world=episodes.name, seed=episodes.seed)
    return Evaluation(name, episodes, action_repeat, seconds, [t for part in driven for t in part], env_config)


def _check_groups(episodes: EpisodeSet, agents: int) -> None:
    """Raises an error unless each ``agents`` consecutive episodes are in the same world."""
    worlds = episodes.world_index
    if len(worlds) % agents or (worlds.reshape(-1, agents) != worlds[::agents, None]).any():
        raise ValueError(
            f"agents={agents} consecutive episodes must be in the same world; draw them with draw_episodes(..., "
            f"agents={agents})"
        )


def _with_few_worlds(episodes: EpisodeSet, rows: int) -> list[EpisodeSet]:
    """Divides episodes into parts of consecutive ones that are in ``rows`` worlds at most."""
    begins, worlds = [0], set[int]()
    for episode, world in enumerate(episodes.world_index.tolist()):
        if len(worlds | {world}) > rows:
            begins.append(episode)
            worlds = set()
        worlds.add(world)
    return [episodes.part(begin, end) for begin, end in pairwise([*begins, len(episodes)])]


def _drive_episodes(
    policy: Policy,
    episodes: EpisodeSet,
    env: EnvConfig,
    action_repeat: int,
    seconds: float,
    name: str,
    watch: Watcher | None,
) -> list[Trajectory]:
    """Drives episodes with as many rovers as ``env`` has. Their number is at least that of the worlds."""
    schedule = _Schedule(episodes.world_index.tolist(), min(env.num_envs or 1, len(episodes)), env.agents > 1)
    worlds = [episodes.pool[index] for index in schedule.worlds[:: env.agents]]
    env = replace(
        env,
        world=tuple(worlds) if len(set(worlds)) > 1 else worlds[0],
        num_envs=len(schedule.first),
        seed=episodes.seed + episodes.offset,
    )
    rovers = RoverEnv(env)
    rovers.length = max(1, round(seconds / rovers.control_dt))
    places = {"start": episodes.start, "goal": episodes.goal}
    return _drive(rovers, policy, action_repeat, name, schedule, places, episodes.offset, watch)


def evaluate_endless(
    policy: Policy | None,
    world: str | World,
    *,
    name: str | None = None,
    rows: int = 32,
    seed: int = DEFAULT_SEED,
    offset: int = 0,
    jam: bool = True,
    steps: int = EnvConfig.length,
    action_repeat: int | None = None,
    env: EnvConfig | None = None,
) -> EndlessEvaluation:
    """Evaluates a policy in endless mode: episodes of up to 2,000 steps, with a new goal whenever one is reached.

    Args:
        policy: policy to evaluate, as for :func:`evaluate`.
        world: world to drive in.
        name: name of the policy, for tables and plots.
        rows: number of rovers, each of which drives one episode.
        seed: seed of the episodes; episode ``i`` is that of an environment seeded ``seed + i``.
        offset: index of the first episode.
        jam: whether a collision of more than 15 steps ends an episode, as in the contract. In the original it never
            does: its counter is never incremented.
        steps: number of steps after which an episode ends.
        action_repeat: number of steps that each action is held for, as for :func:`evaluate`.
        env: environment to drive in, as for :func:`evaluate`.

    Raises:
        ValueError: for a number out of range, an unknown world, or a policy that was made for another environment.
    """
    action_repeat = default_action_repeat(policy, action_repeat)
    check_options(rows=rows, steps=steps, action_repeat=action_repeat)
    name = name or ("random" if policy is None else "policy")
    env_config, place = environment_for(policy, env), get_world(world)
    task = env_config.task if jam else replace(env_config.task, collision_window=steps)
    env_config = replace(
        env_config, world=place, num_envs=rows, length=steps, end_on_goal=False, seed=seed + offset, task=task
    )
    rovers = RoverEnv(env_config)
    schedule = _Schedule([0] * rows, rows)
    trajectories = _drive(rovers, policy or RandomPolicy(seed), action_repeat, name, schedule, offset=offset)
    world_name = world if isinstance(world, str) else place.name
    env_config = replace(env_config, world=world_name, seed=seed)
    return EndlessEvaluation(name, world_name, place, seed, action_repeat, jam, steps, trajectories, env_config)


def check_options(*, seconds: float = 60.0, rows: int = 1, steps: int = 1, action_repeat: int = 1) -> None:
    """Checks numbers that are given to :func:`evaluate` or :func:`evaluate_endless`."""
    check_at_least(CONTROL_DT, MAX_SECONDS, seconds=seconds)
    check_at_least(1, MAX_COUNT, rows=rows, steps=steps, action_repeat=action_repeat)


def environment_for(policy: Policy | None, env: EnvConfig | None) -> EnvConfig:
    """Returns the environment to evaluate a policy in: see :func:`evaluate`."""
    made_for: EnvConfig | None = getattr(policy, "made_for", None)
    if env is None:
        # By default, policies are compared in Bullet without randomization, whatever they were trained with.
        parts = made_for or EnvConfig()
        return EnvConfig(
            robot=parts.robot,
            lidar=parts.lidar,
            sensors=parts.sensors,
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
    env: RoverEnv,
    policy: Policy,
    action_repeat: int,
    name: str,
    schedule: _Schedule,
    places: Mapping[str, Tensor] | None = None,
    offset: int = 0,
    watch: Watcher | None = None,
) -> list[Trajectory]:
    """Drives episodes and closes the environment. A rover takes the next episode when its own has ended."""
    places = places or {}
    runner = PolicyRunner(policy, action_repeat, _MIN_ROWS, env)
    recorder = _Recorder(schedule.count, env.length, env.control_dt, watch)
    episode = torch.tensor(schedule.first)
    driving = torch.ones(env.num_envs, dtype=torch.bool)

    def placed() -> dict[str, Tensor]:
        return {key: values[episode] for key, values in places.items()}

    with closing(env), ProgressDisplay(name) as display, set_exploration_type(ExplorationType.DETERMINISTIC):
        tensordict = env.reset(**placed())
        recorder.add(env, tensordict, episode, driving)
        while driving.any():
            action = runner(tensordict.set("episode", offset + episode[:, None]))
            tensordict = env.step(tensordict.set("action", action).set("_step", driving))["next"]
            recorder.add(env, tensordict, episode, driving)
            restarting = driving & tensordict["done"].squeeze(-1)
            for row in restarting.nonzero().squeeze(-1).tolist():
                recorder.end(tensordict[row], int(episode[row]))
                next_episode = schedule.next(row)
                driving[row] = restarting[row] = next_episode is not None
                episode[row] = episode[row] if next_episode is None else next_episode
            if restarting.any():
                tensordict = env.reset(tensordict.set("_reset", restarting[:, None]), **placed())
                runner.reset(restarting)
                recorder.add(env, tensordict, episode, restarting)
            display.update(recorder.progress)
    return recorder.trajectories


class _Schedule:
    """Distribution of episodes over rovers, each of which stays in one world.

    The first episodes of the worlds are assigned to rovers first, then the second ones, and so on. A rover that has
    ended an episode takes the next one in its world. With ``in_order``, all episodes have a rover, in their order.
    """

    def __init__(self, worlds: Sequence[int], rows: int, in_order: bool = False) -> None:
        self.count = len(worlds)
        taken: Counter[int] = Counter()
        turns = []
        for episode, world in enumerate(worlds):
            turns.append((taken[world], episode))
            taken[world] += 1
        order = [episode for _, episode in (turns if in_order else sorted(turns))]
        self.first = order[:rows]
        self.worlds = [worlds[episode] for episode in self.first]
        self._waiting: dict[int, deque[int]] = {world: deque() for world in self.worlds}
        for episode in order[rows:]:
            self._waiting[worlds[episode]].append(episode)

    def next(self, row: int) -> int | None:
        """Returns the next episode of a rover; ``None`` if there is no further one in its world."""
        waiting = self._waiting[self.worlds[row]]
        return waiting.popleft() if waiting else None


class _Recorder:
    """Records episodes step by step, in one tensor for all of them."""

    def __init__(self, count: int, length: int, dt: float, watch: Watcher | None = None) -> None:
        self._dt, self._watch = dt, watch
        # Position (3), angles (3), collision, goal.
        self._records = torch.zeros(count, length + 1, 8)
        self._steps = torch.zeros(count, dtype=torch.int64)
        self._endings = [""] * count

    def add(self, env: RoverEnv, tensordict: TensorDictBase, episode: Tensor, rows: Tensor) -> None:
        """Records a step.

        Args:
            env: environment after the step.
            tensordict: observation after the step.
            episode: episode that each rover drives, int64 ``[N]``.
            rows: rovers to record, bool ``[N]``.
        """
        outcome, rover = tensordict["outcome"], env.rover_state
        events = (outcome["collision"], outcome["goal_reached"])
        record = torch.cat((rover.position, quaternion_to_euler(rover.orientation), *events), -1)
        steps = outcome["steps"].squeeze(-1)
        self._records[episode[rows], steps[rows]] = record[rows]
        self._steps[episode[rows]] = steps[rows]
        if self._watch is not None:
            self._watch(env, episode, rows)

    def end(self, tensordict: TensorDictBase, episode: int) -> None:
        """Records the ending of an episode from the observation after its last step."""
        early = bool(tensordict["terminated"])
        self._endings[episode] = ENDINGS[StepEvent(int(tensordict["outcome", "phase"]))] if early else TIME_LIMIT

    @property
    def progress(self) -> float:
        """Mean fraction of the episodes that is done."""
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
