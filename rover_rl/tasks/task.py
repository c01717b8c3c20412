"""``Task``: a decision process by name, how policies are judged in it, and settings of its learners."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from rover_rl.envs.config import EnvConfig, RobotLike
from rover_rl.envs.parts import BUILT_IN_TASKS, TASKS, task_gym_id
from rover_rl.envs.sensors.suite import BUILT_IN
from rover_rl.names import TRAINING_SEEDS, Name, check_training_seed

TEST_SEED = 50_000
"""Seed of the environment of a test, and by convention of its first world."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A task: the environment to train in, what a policy reads, the test, and settings of its learners.

    A policy succeeds in an episode of the test if it reaches the goal within ``seconds`` and its body touches nothing.
    Worlds with seeds below 10,000 are for training, others for the test.

    Example:
        >>> from rover_rl import EnvConfig
        >>> forest = Task(
        ...     name="forest",
        ...     reason="Trees stand so close that the straight way is never free.",
        ...     observation=("lidar", "imu", "target", "velocities"),
        ...     env=EnvConfig(world="forest:0-299", backend="warp", length=600),
        ...     test_world="forest:50000-50063",
        ... )
        >>> forest.test_env.task.collision_from
        'contact'
    """

    name: str
    """Name of the task: lowercase words with hyphens."""
    reason: str
    """What a learner has to find that is not on a map, in one sentence."""
    observation: tuple[str, ...]
    """Entries of the observation that a policy may read."""
    env: EnvConfig
    """Environment to train in."""
    test_world: str | tuple[str, ...]
    """Worlds of the test."""
    test_robot: RobotLike | None = None
    """Robots of the test. Default: those of the training."""
    episodes: int = 4
    """Number of episodes of the test in each of its worlds."""
    seconds: float = 60.0
    """Time limit of an episode of the test, s."""
    references: tuple[str, ...] = ("scripted", "gridplanner", "dwa", "expert")
    """Policies without training that the test is driven with for comparison."""
    learners: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: MappingProxyType({"ppo": {}}))
    """Settings of each learner beside the defaults, by their names alone. ``algo`` is ``"ppo"`` unless it says so. The
    first learner is the one that wins by the clock."""

    def __post_init__(self) -> None:
        worlds = (self.test_world,) if isinstance(self.test_world, str) else self.test_world
        for world in self.env.worlds:
            if isinstance(world, str):
                check_training_seed(world)
        drawn = {
            Name.parse(world).part for world in self.env.worlds if isinstance(world, str) and Name.parse(world).is_range
        }
        own = [Name.parse(one).part if isinstance(one, str) else getattr(one, "name", "") for one in self.env.sensors]
        unknown = [entry for entry in self.observation if entry not in (*BUILT_IN, *own)]
        if unknown and {*own} <= {*BUILT_IN}:
            raise ValueError(f"observation names {unknown}, and the environment has {[*BUILT_IN]}")
        for name in map(Name.parse, worlds):
            if name.is_range and name.settings["seed"][0] < TRAINING_SEEDS:
                raise ValueError(f"test_world must have seeds from {TRAINING_SEEDS} up, got {name}")
            if name.part in drawn and not name.is_range:
                raise ValueError(f"test_world must be a range of seeds where the training has one, got {name}")
        if not self.learners:
            raise ValueError("learners must name at least one, such as {'ppo': {}}")

    @property
    def gym_id(self) -> str:
        """Gymnasium ID of the task, such as ``"rover_rl/RoomsPeople-v0"``."""
        return task_gym_id(self.name)

    @property
    def test_env(self) -> EnvConfig:
        """Environment of the test: that of the training in other worlds, where any contact ends an episode."""
        env = self.env
        task = replace(env.task, collision_from="contact", collision_window=0)
        length = round(self.seconds / env.control_dt)
        robot = self.test_robot or env.robot
        return replace(
            env, world=self.test_world, robot=robot, task=task, length=length, end_on_goal=True, seed=TEST_SEED
        )


def get_task(name: str) -> Task:
    """Returns a task by its name or ``"module:attribute"``. Raises ``ValueError`` if there is none."""
    found = TASKS.find(name)
    if not isinstance(found, Task):
        raise ValueError(f"task must be one of {task_names()}, or a Task, got {found!r}")
    return found


def task_names() -> list[str]:
    """Returns the names of the tasks: those of the package in their order, then others."""
    return [*dict.fromkeys((*BUILT_IN_TASKS, *TASKS.names()))]
