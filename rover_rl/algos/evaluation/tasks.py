"""Tests of tasks: the environment in which a policy is judged, and which of the given words is a task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rover_rl.algos.evaluation.episodes import choose_episodes
from rover_rl.algos.evaluation.evaluate import Request, evaluate_all
from rover_rl.algos.evaluation.results import Evaluation
from rover_rl.algos.policy.names import PRETRAINED
from rover_rl.algos.policy.runner import Policy
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.parts import HEADING, TASKS
from rover_rl.registry import is_path
from rover_rl.tasks.task import Task

_OWN = ("lidar", "sensors", "action", "heading_gains", "compensate_delay")
"""Settings that an entry brings along: what it makes of the sensors, and how it steers."""


def test_env(task: Task, policy: Policy | None) -> EnvConfig:
    """Returns the environment of a task's test for a policy, with the sensors and the action that it was made for.

    The baselines have the contract's action.
    """
    env = task.test_env
    made_for: EnvConfig | None = getattr(policy, "made_for", None)
    if made_for is not None:
        return replace(env, **{key: getattr(made_for, key) for key in _OWN})
    is_baseline = type(policy).__module__.startswith("rover_rl.")
    return replace(env, action=replace(env.action, kind=HEADING)) if is_baseline else env


def for_task(task: Task, policy: Policy | None) -> Policy | None:
    """Returns a policy that reads a task's observation, where its file does not say what it was trained with."""
    reading = getattr(policy, "reading", None)
    return policy if reading is None else reading(task.test_env, task.observation)


def judge(
    task: Task, policy: Policy | None, name: str, *, action_repeat: int | None = None, workers: int | None = None
) -> list[Evaluation]:
    """Evaluates a policy in a task's test, as ``rover-rl evaluate TASK POLICY`` does: once for each range of worlds."""
    policy = for_task(task, policy)
    env = test_env(task, policy)
    sets = [choose_episodes(world, task.episodes, robot=env.robot, workers=workers) for world in env.world_names]
    options = {"name": name, "env": env, "seconds": task.seconds, "action_repeat": action_repeat}
    return evaluate_all([Request(policy, episodes, options) for episodes in sets], workers)


def split_task(words: Sequence[str]) -> tuple[Task | None, tuple[str, ...]]:
    """Returns the task that the first word names, if it names one, and the other words.

    A word that is a file or folder is none, nor is the ``"module:attribute"`` of something else.
    """
    if not words or words[0].startswith(PRETRAINED) or Path(words[0]).exists():
        return None, tuple(words)
    if words[0] in TASKS.names() or is_path(words[0]):
        found = TASKS.find(words[0])
        if isinstance(found, Task):
            return found, tuple(words[1:])
    return None, tuple(words)
