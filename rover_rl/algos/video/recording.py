"""Recorded drives, which films show."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from rover_rl.algos.driving import Step, drives
from rover_rl.algos.evaluation.episodes import EpisodeSet
from rover_rl.algos.evaluation.evaluate import Policy, environment_for, evaluate, rows_of
from rover_rl.algos.evaluation.results import StoredEvaluation
from rover_rl.algos.policy.baselines import RandomPolicy
from rover_rl.algos.policy.runner import sensors_for
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.make import add_terms, check_terms
from rover_rl.envs.rover import RoverEnv
from rover_rl.native.threads import single_threaded
from rover_rl.progress import ProgressDisplay
from rover_rl.robots import Robot
from rover_rl.sims.movers.field import shown_parts
from rover_rl.sims.rover_state import RoverState
from rover_rl.worlds import World
from rover_rl.worlds.movers.parts import Parts

SHOWN = 5.0  # distance up to which the nearest lidar reading is plotted, m
State: TypeAlias = tuple[RoverState, Tensor, Parts | None]  # state and scan of a rover, and the movers around it


@dataclass(frozen=True)
class Moment:
    """State of ``N`` rovers at a time (s) of a video: scans ``[N, beams]`` and current goals ``[N, 2]``, m.

    ``goals`` and ``episodes`` count those that each has reached and ended. ``endings`` are those of all episodes so
    far, ``event`` is the last one of the first rover, and its time (s). ``movers`` are those around the first rover.
    """

    seconds: float
    rover: RoverState
    scan: Tensor
    goal: Tensor
    goals: Tensor
    episodes: Tensor
    endings: Sequence[str] = ()
    event: tuple[str, float] = ("", 0.0)
    movers: Parts | None = None


@dataclass(frozen=True)
class Recording:
    """A recorded drive."""

    moments: list[Moment]  #: States at the start and after each step.
    world: World
    robot: Robot
    ray_angles: Tensor  #: Direction of each lidar beam in the rover's frame, ``[beams]``, rad.
    dt: float  #: Duration of a step, s.
    ending: str = ""  #: How the episode ended; empty in endless mode.
    episode: int = 0  #: Index of the episode in its set.
    steps: list[TensorDict] = field(default_factory=list)
    """Steps of the first rover with their rewards; empty for single episodes."""

    @property
    def seconds(self) -> float:
        return (len(self.moments) - 1) * self.dt

    def last(self, seconds: float) -> Recording:
        """The end of the drive, of the given duration (s) or all of a shorter drive."""
        return replace(self, moments=self.moments[-1 - max(1, round(seconds / self.dt)) :])


@dataclass(frozen=True)
class Episode:
    """An episode that has ended: its rover, number from 1, duration (s), ending and number of goals reached."""

    row: int
    number: int
    seconds: float
    ending: str
    goals: int


class Tally:
    """Counts the ``goals`` that rovers have reached and the ``episodes`` that they have ended, int64 ``[N]``.

    ``ended`` are these episodes, in order. ``event`` is the last one of the followed rover, and its time (s).
    """

    def __init__(self, count: int) -> None:
        self.goals = self.episodes = self._goals_before = torch.zeros(count, dtype=torch.int64)
        self.ended: list[Episode] = []
        self.event = "", 0.0

    def add(self, step: Step, seconds: float, dt: float, row: int = 0) -> None:
        """Counts a step, which ends at ``seconds`` and takes ``dt`` (s). ``row`` is the followed rover."""
        outcome = step.observation["outcome"]
        reached = outcome["goal_reached"].squeeze(-1).cpu()
        self.goals, self.episodes = self.goals + reached, self.episodes + step.ended
        endings, took = step.endings(), outcome["steps"].squeeze(-1) * dt
        for one, ending in endings.items():
            goals = int(self.goals[one] - self._goals_before[one])
            self.ended.append(Episode(one, int(self.episodes[one]), took[one].item(), ending, goals))
        self._goals_before = torch.where(step.ended, self.goals, self._goals_before)
        if row in endings or reached[row]:
            self.event = f"{endings[row]}: new start" if row in endings else "goal reached", seconds

    def moment(self, seconds: float, rovers: RoverEnv, row: int = 0) -> Moment:
        seen, endings = (rovers.rover_state, rovers.scan, rovers.goal), [one.ending for one in self.ended]
        return Moment(seconds, *seen, self.goals, self.episodes, endings, self.event, shown_parts(rovers.movers, row))


@single_threaded()
def record_endless(
    policy: Policy | None, world: str | World, *, seconds: float, rows: int, seed: int, env: EnvConfig | None
) -> Recording:
    """Drives in endless mode: a reached goal is followed by a new goal, an ended episode by a new start."""
    config = environment_for(policy, env)
    config = sensors_for(policy, replace(config, world=world, num_envs=rows, end_on_goal=False, seed=seed))
    check_terms(config)
    rovers = RoverEnv(config)
    steps = max(1, round(seconds / rovers.control_dt))
    rovers.length = steps + 1
    rewarded = add_terms(rovers, config)
    driven: list[TensorDict] = []
    moments: list[Moment] = []
    tally = Tally(rows)
    with closing(rewarded), ProgressDisplay("driving") as display:
        for step in drives(rewarded, policy or RandomPolicy(seed)):
            if step.transition is None:
                del moments[-1:]  # A new start takes the place of the end.
            else:
                driven.append(step.transition.select("action", "next")[0])
                tally.add(step, len(driven) * rovers.control_dt, rovers.control_dt)
                display.update(len(driven) / steps)
            moments.append(tally.moment(len(driven) * rovers.control_dt, rovers))
            if len(driven) == steps:
                break
        angles = rovers.scanner.angles.cpu()
        return Recording(moments, rovers.worlds[0], rovers.fleet[0], angles, rovers.control_dt, steps=driven)


def record_episodes(
    policy: Policy | None, episodes: EpisodeSet, wanted: Sequence[int] | None = None, **options: Any
) -> list[Recording]:
    """Evaluates a policy with options of ``evaluate``, and records its drives of the ``wanted`` episodes, or all."""
    wanted = range(len(episodes)) if wanted is None else wanted
    states: dict[int, list[State]] = {index: [] for index in wanted}
    angles, dt = torch.zeros(0), 0.0

    def watch(rovers: RoverEnv, episode: Tensor, rows: Tensor) -> None:
        nonlocal angles, dt
        angles, dt = rovers.scanner.angles.cpu(), rovers.control_dt
        for row in rows.nonzero().squeeze(-1).tolist():
            if (index := int(episode[row])) in states:
                seen = rovers.rover_state[row : row + 1].cpu(), rovers.scan[row : row + 1].cpu()
                states[index].append((*seen, shown_parts(rovers.movers, row)))

    # As in an evaluation: a randomized drive depends on its row.
    rows = rows_of(episodes, options.get("env"))
    evaluation = evaluate(policy, episodes, rows=rows, watch=watch, **options)
    recordings = []
    for index in wanted:
        ending, place = evaluation.endings[index], (episodes.worlds[index], evaluation.robots[index])
        moments = moments_of(states[index], episodes.goal[index : index + 1], dt, ending)
        recordings.append(Recording(moments, *place, angles, dt, ending, episodes.offset + index))
    return recordings


def record_stored(policy: Policy | None, stored: StoredEvaluation, episode: int) -> Recording:
    episodes = stored.to_drive(episode)
    options: dict[str, Any] = {"action_repeat": stored.action_repeat, "seconds": stored.seconds, "env": stored.env}
    return record_episodes(policy, episodes, [episode - episodes.offset], name=f"episode {episode}", **options)[0]


def curves_of(recording: Recording) -> dict[str, np.ndarray]:
    """Speed, distance to the goal and the nearest lidar reading of the first rover, ``[moments]`` each."""
    moments = recording.moments
    distances = [torch.dist(one.rover.position[0, :2].cpu(), one.goal[0].cpu()).item() for one in moments]
    nearest = [one.scan[0].nan_to_num(nan=torch.inf).clamp(0, SHOWN).min().item() for one in moments]
    speeds = [one.rover.linear_velocity[0].item() for one in moments]
    named = {"speed, m/s": speeds, "distance to the goal, m": distances, "nearest lidar reading, m": nearest}
    return {name: np.array(values) for name, values in named.items()}


def moments_of(states: Sequence[State], goal: Tensor, dt: float, ending: str) -> list[Moment]:
    none, one = torch.zeros(1, dtype=torch.int64), torch.ones(1, dtype=torch.int64)
    moments = [Moment(k * dt, *seen[:2], goal, none, none, movers=seen[2]) for k, seen in enumerate(states)]
    reached = ending == "goal"
    event, endings = ("goal reached" if reached else ending, moments[-1].seconds), () if reached else (ending,)
    moments[-1] = replace(moments[-1], goals=one if reached else none, endings=endings, event=event)
    return moments
