"""Evaluation of policies on fixed episodes, or in endless mode as in the original environment.

Example:
    >>> actor = Checkpoint.load("runs/ppo-moon").make_actor()
    >>> episodes = stored_episodes("maze").first(2)
    >>> print_table([evaluate(actor, episodes, name="PPO", seconds=2), evaluate(None, episodes, seconds=2)])
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import pairwise
from operator import methodcaller
from typing import Any

import torch
from torch import Tensor

from rover_rl.algos.driving import Schedule, Step, drives
from rover_rl.algos.evaluation.cores import over_cores
from rover_rl.algos.evaluation.episodes import EpisodeSet
from rover_rl.algos.evaluation.results import EPISODES_PER_PART, Evaluation
from rover_rl.algos.evaluation.trajectory import Encounters, MoverTrack, Trajectory
from rover_rl.algos.policy.baselines import RandomPolicy
from rover_rl.algos.policy.runner import Policy, default_action_repeat, sensors_for
from rover_rl.checks import MAX_COUNT, MAX_SECONDS, check_at_least
from rover_rl.envs.config import EnvConfig, RobotLike, require_match
from rover_rl.envs.make import add_terms
from rover_rl.envs.parts import HEADING
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.rows import first_of_group
from rover_rl.native.threads import single_threaded
from rover_rl.progress import ProgressDisplay
from rover_rl.rng import episode_keys, row_keys
from rover_rl.robots import get_robots, names_several
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims.free_space.fitting import passage_scale
from rover_rl.sims.settings import CONTROL_DT
from rover_rl.tasks.task import Task

ROWS = 8  # number of rovers of a part of an evaluation in one world: with more, more of them wait for the last one
BATCHED_PER_PART = 128  # EPISODES_PER_PART of several worlds in Warp, which steps many rovers almost as fast as few
SMALL = 16  # number of episodes below which starting processes takes longer than the evaluation
_MIN_ROWS = 32  # smallest number of rows that a policy is called with: matrix products of few rows round differently
MADE_FOR = ("robot", "lidar", "sensors", "action", "task", "heading_gains", "limits")
"""Settings of an environment that a policy was made for."""
_KEPT = (*MADE_FOR, "terminate", "control_rate", "compensate_delay")  # settings that it is evaluated with by default
_OWN = ("lidar", "sensors", "action", "heading_gains")
"""Settings that an entry brings along: what it makes of the sensors, and how it steers."""


def evaluate(
    policy: Policy | None,
    episodes: EpisodeSet,
    *,
    name: str | None = None,
    action_repeat: int | None = None,
    seconds: float | None = None,
    rows: int = 32,
    env: EnvConfig | None = None,
    watch: Callable[[RoverEnv, Tensor, Tensor], None] | None = None,
    track_movers: bool | float = False,
    jam: bool = True,
) -> Evaluation:
    """Evaluates a policy on episodes with a time limit, with one goal each or endless.

    If the policy treats rows independently, the result of an episode is bit-identical for any number of ``rows`` and
    any other episodes.

    With ``env.agents``, the rovers of that many consecutive episodes drive at once in the same world; draw such
    episodes with ``draw_episodes(..., agents=...)``. A rover whose episode has ended stays where it is until those of
    the others have. All episodes are driven at once then, whatever ``rows`` is; endless ones always are.

    Args:
        policy: module that maps observations to actions, used without exploration; ``None`` acts at random.
        action_repeat: number of steps that each action is held for; 1 decides at 20 Hz. ``None``: 1, and for a policy
            with memory the number in training.
        seconds: time limit of each episode, s; ``None``: that of :func:`usual_seconds`.
        rows: number of rovers that drive at once; each takes the next episode in its world when its own has ended.
        env: environment to drive in; ``None``: the one that the policy was made for, in Bullet and without
            randomization, else the defaults.
        watch: function that is called at the start and after each step of the episodes, with the environment, the
            index of each rover's episode, int64 ``[N]``, and the rovers that it concerns, bool ``[N]``.
        track_movers: whether the trajectories keep where the movers are, or for how long before the end of an episode,
            s. A mover takes 28 bytes per step and solid.
        jam: whether a collision of more than 15 steps ends an endless episode, as in the contract. In the original it
            never does: its counter is never incremented.

    Raises:
        ValueError: for a number out of range, or a policy or episodes that do not fit the environment.
    """
    config = environment_for(policy, env)
    action_repeat = repeat = default_action_repeat(policy, action_repeat, config.control_dt)
    seconds = usual_seconds(config, episodes) if seconds is None else seconds
    check_options(rows=rows, seconds=seconds, action_repeat=action_repeat)
    name = name or ("random" if policy is None else "policy")
    endless, agents, length = episodes.endless, config.agents, max(1, round(seconds / config.control_dt))
    worlds = episodes.world_index
    if not endless and (len(worlds) % agents or (worlds.reshape(-1, agents) != worlds[::agents, None]).any()):
        draw = f"draw them with draw_episodes(..., agents={agents})"
        raise ValueError(f"agents={agents} consecutive episodes must be in the same world; {draw}")
    rows = len(episodes) if agents > 1 or endless else min(rows, len(episodes))
    config = replace(config, num_envs=rows, end_on_goal=not endless)
    if endless:
        task = config.task if jam else replace(config.task, collision_window=length)
        config = replace(config, length=length, task=task)
    described = sensors_for(policy, config, action_repeat)

    def drive(part: EpisodeSet) -> list[Trajectory]:
        schedule = _Schedule(part, min(rows, len(part)), in_order=agents > 1)
        worlds = [part.pool[index] for index in schedule.worlds[::agents]]
        place, seed = tuple(worlds) if len(set(worlds)) > 1 else worlds[0], part.seed + part.offset
        rovers = RoverEnv(replace(described, world=place, num_envs=len(schedule.worlds), seed=seed))
        rovers.length = length
        schedule.enter(rovers, first_of_group(episode_keys(row_keys(seed, len(part), rovers.goal.device), 1), agents))
        recorder = _Recorder(len(part), rovers, track_movers)
        env = add_terms(rovers)
        steps = drives(env, policy or RandomPolicy(part.seed), schedule, action_repeat=repeat, min_rows=_MIN_ROWS)
        with closing(env), ProgressDisplay(name) as display, single_threaded():
            for step in steps:
                recorder.add(rovers, step, schedule.number)
                if watch is not None:
                    watch(rovers, schedule.number, step.rows)
                display.update(recorder.progress)
        return [recorder.trajectory(episode) for episode in range(len(part))]

    driven = over_cores(drive, _with_few_worlds(episodes, rows), name, workers=1)
    config = replace(config, world=episodes.name, seed=episodes.seed)
    return Evaluation(name, episodes, action_repeat, seconds, [t for part in driven for t in part], config, jam=jam)


def _with_few_worlds(episodes: EpisodeSet, rows: int) -> list[EpisodeSet]:
    """Divides episodes into parts of consecutive ones that are in ``rows`` worlds at most."""
    begins, worlds = [0], set[int]()
    for episode, world in enumerate(episodes.world_index.tolist()):
        if len(worlds | {world}) > rows:
            begins.append(episode)
            worlds = set()
        worlds.add(world)
    return [episodes.part(begin, end) for begin, end in pairwise([*begins, len(episodes)])]


def usual_seconds(env: EnvConfig, episodes: EpisodeSet) -> float:
    """Usual time limit of the episodes of a set, s.

    It is 60 s, longer by the scale of the worlds that the robot needs, or 4 s for each meter of the longest of the
    shortest paths if that is more; both are longer by as much as the robot is slower than 1 m/s. Endless episodes have
    the 2,000 steps of the contract.
    """
    if episodes.endless:
        return EnvConfig.length * env.control_dt
    longest = float(episodes.shortest.nan_to_num(0.0, posinf=0.0).max())
    robots = get_robots(env.robot)
    times = (max(60 * passage_scale(one), 4 * longest) / min(1.0, one.drive.max_speed) for one in robots)
    return min(round(max(times)), MAX_SECONDS)


def check_options(*, seconds: float = 60.0, rows: int = 1, action_repeat: int = 1) -> None:
    check_at_least(CONTROL_DT, MAX_SECONDS, seconds=seconds)
    check_at_least(1, MAX_COUNT, rows=rows, action_repeat=action_repeat)


def environment_for(policy: Policy | None, env: EnvConfig | None) -> EnvConfig:
    made_for: EnvConfig | None = getattr(policy, "made_for", None)
    if env is None:
        # By default, policies are compared in Bullet without randomization, whatever they were trained with.
        settings = {key: getattr(made_for or EnvConfig(), key) for key in _KEPT}
        return EnvConfig(**settings, backend=default_backend(settings["robot"]))
    if made_for is not None:
        require_match(made_for, env)
    return replace(env, privileged=False)


def test_env(task: Task, policy: Policy | None) -> EnvConfig:
    """Returns the environment of a task's test for a policy, with the sensors and the action that it was made for.

    Delays are compensated if the task or the policy says so.
    The baselines have the contract's action.
    """
    env = task.test_env
    made_for: EnvConfig | None = getattr(policy, "made_for", None)
    if made_for is not None:
        compensates = env.compensate_delay or made_for.compensate_delay
        return replace(env, **{key: getattr(made_for, key) for key in _OWN}, compensate_delay=compensates)
    is_baseline = type(policy).__module__.startswith("rover_rl.")
    return replace(env, action=replace(env.action, kind=HEADING)) if is_baseline else env


def for_task(task: Task, policy: Policy | None) -> Policy | None:
    """Returns a policy that reads a task's observation, where its file does not say what it was trained with."""
    reading = getattr(policy, "reading", None)
    return policy if reading is None else reading(task.test_env, task.observation)


def default_backend(robot: RobotLike) -> str:
    """Simulator in which policies are compared by default: Bullet, or Warp for several robots."""
    return "warp" if names_several(robot) else "bullet"


def rows_of(episodes: EpisodeSet, env: EnvConfig | None) -> int:
    """Number of rovers that drive the episodes of a part of an evaluation.

    It is that of the episodes in several worlds, as rovers stay in theirs, and in Warp, where more take hardly longer.
    """
    return len(episodes) if episodes.several_worlds or (env is not None and env.backend == "warp") else ROWS


@dataclass(frozen=True)
class Request:
    """Request for an evaluation, with further arguments of :func:`evaluate`."""

    policy: Policy | None
    episodes: EpisodeSet
    options: dict[str, Any] = field(default_factory=dict)

    def parts(self) -> list[Request]:
        episodes, env = self.episodes, self.options.get("env")
        batched = episodes.several_worlds and env is not None and env.backend == "warp"
        size, agents = BATCHED_PER_PART if batched else EPISODES_PER_PART, 1 if env is None else env.agents
        size = ROWS if episodes.endless else size
        size = max(agents, size - size % agents)  # whole groups, at least one
        parts = (episodes.part(first, first + size) for first in range(0, len(episodes), size))
        # The usual time limit is that of the whole set.
        usual = {"seconds": usual_seconds(environment_for(self.policy, env), episodes)}
        options = usual | {name: value for name, value in self.options.items() if value is not None}
        return [replace(self, episodes=part.with_used_worlds(), options=options) for part in parts]

    def run(self) -> Evaluation:
        """Evaluates the policy in this process. The result has no episodes: :meth:`merge` adds them."""
        rows = rows_of(self.episodes, self.options.get("env"))
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


class _Schedule(Schedule):
    """Distribution of episodes over rovers, each of which stays in one world: ``number`` is that of the one it drives.

    Worlds take turns. With ``in_order``, all episodes have a rover, in their order.
    """

    driving: Tensor

    def __init__(self, episodes: EpisodeSet, rows: int, in_order: bool) -> None:
        self._episodes, worlds = episodes, episodes.world_index.tolist()
        waiting: dict[int, deque[int]] = {}
        for episode, world in enumerate(worlds):
            waiting.setdefault(world, deque()).append(episode)
        turns = sorted((turn, episode) for queue in waiting.values() for turn, episode in enumerate(queue))
        first = [*range(len(worlds))] if in_order else [episode for _, episode in turns[:rows]]
        self.worlds = [worlds[episode] for episode in first]
        for world in self.worlds:
            waiting[world].popleft()
        self._waiting, self.number = waiting, torch.tensor(first)
        self.driving = torch.ones(len(first), dtype=torch.bool)

    def enter(self, env: RoverEnv, keys: Tensor) -> None:
        """Makes movers and robots depend on the ``keys`` of the episodes, int64 ``[count, 1]``, not on the rover."""
        self._env, self._keys = env, keys

    @property
    def episode(self) -> Tensor:  # type: ignore[override]
        return self._episodes.offset + self.number

    def places(self) -> dict[str, Tensor]:
        if self._episodes.endless:
            return {}
        self._env.movers.keys = self._env.robots.keys = self._keys[self.number]
        return {"start": self._episodes.start[self.number], "goal": self._episodes.goal[self.number]}

    def restart(self, ended: Tensor) -> Tensor:
        restarting = ended.clone()
        for row in ended.nonzero().squeeze(-1).tolist():
            if waiting := self._waiting[self.worlds[row]]:
                self.number[row] = waiting.popleft()
            else:
                self.driving[row] = restarting[row] = False
        return restarting


class _Recorder:
    """Records ``count`` episodes. ``track_movers`` is that of :func:`evaluate`."""

    def __init__(self, count: int, env: RoverEnv, track_movers: bool | float) -> None:
        self._dt, self._endings = env.control_dt, [""] * count
        self._has_movers = "mover_contact" in env.observation_spec["outcome"]
        # Position (3), angles (3), collision, goal; with movers also contact, gap, distance of centers.
        self._records = torch.zeros(count, env.length + 1, 11 if self._has_movers else 8)
        self._steps = torch.zeros(count, dtype=torch.int64)
        self._tracking = bool(track_movers) and self._has_movers
        kept = None if track_movers is True else 1 + round(track_movers / self._dt)
        self._solids: list[list[Tensor]] = [[]] * count
        self._places = [deque[Tensor](maxlen=kept) for _ in range(count)]

    def add(self, env: RoverEnv, step: Step, episode: Tensor) -> None:
        outcome, rover, rows = step.observation["outcome"], env.rover_state, step.rows
        values = [rover.position, quaternion_to_euler(rover.orientation), outcome["collision"], outcome["goal_reached"]]
        if self._has_movers:
            gap = (outcome["mover_distance"] - env.robot.radius).clamp(min=0)
            values += [outcome["mover_contact"], gap, env.movers.nearest_center(rover.position[:, :2])]
        steps = outcome["steps"].squeeze(-1).to("cpu")[rows]
        self._records[episode[rows], steps] = torch.cat(values, -1).to("cpu")[rows]
        self._steps[episode[rows]] = steps
        if self._tracking:
            self._track(env, episode, rows)
        for row, ending in step.endings().items():
            self._endings[int(episode[row])] = ending

    def _track(self, env: RoverEnv, episode: Tensor, rows: Tensor) -> None:
        if (parts := env.movers.parts) is None:
            return
        for row in rows.nonzero().squeeze(-1).tolist():
            number, present = int(episode[row]), parts.kind[row] >= 0
            if not self._places[number]:
                self._solids[number] = [each[row][present].cpu() for each in (parts.kind, parts.half, parts.mover)]
            places = torch.cat((parts.position[row], parts.orientation[row]), -1)
            self._places[number].append(places[present].cpu())

    @property
    def progress(self) -> float:
        ended = torch.tensor([bool(ending) for ending in self._endings])
        return torch.where(ended, 1.0, self._steps / (self._records.shape[1] - 1)).mean().item()

    def trajectory(self, episode: int) -> Trajectory:
        record = self._records[episode, : self._steps[episode] + 1]
        position, angles, events, met = record.tensor_split((3, 6, 8), -1)
        collision, goal = events[1:].bool().unbind(-1)
        encounters = track = None
        # In a world without movers, the nearest one is infinitely far away.
        if self._has_movers and met[0, 1].isfinite():
            contact, gap, center_distance = met.unbind(-1)
            encounters = Encounters(contact.bool(), gap, center_distance)
            if self._tracking:
                kind, half, mover = self._solids[episode]
                track = MoverTrack(kind, half, mover, *torch.stack([*self._places[episode]]).split((3, 4), -1))
        ending = self._endings[episode]
        return Trajectory(position, angles, collision, goal, ending, dt=self._dt, encounters=encounters, movers=track)
