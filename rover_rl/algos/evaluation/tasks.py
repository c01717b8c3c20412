"""Tests of tasks: the environment in which a policy is judged, and which of the given words is a task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rover_rl.algos.policy.names import PRETRAINED
from rover_rl.algos.policy.runner import Policy
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.parts import TASKS
from rover_rl.registry import is_path
from rover_rl.tasks.task import Task

_OWN = ("lidar", "sensors", "action", "heading_gains", "compensate_delay")
"""Settings that an entry brings along: what it makes of the sensors, and how it steers."""


def test_env(task: Task, policy: Policy | None) -> EnvConfig:
    """Returns the environment of a task's test for a policy, with the sensors and the action that it was made for."""
    made_for: EnvConfig | None = getattr(policy, "made_for", None)
    return replace(task.test_env, **{} if made_for is None else {key: getattr(made_for, key) for key in _OWN})


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
