"""Tasks: named decision processes with worlds to train and to test in, a file each.

Example:
    >>> from rover_rl import make_env
    >>> env = make_env(task="mazes", num_envs=4, seed=0)
    >>> get_task("mazes").test_world
    'maze:50000-50063'
"""

from __future__ import annotations

from rover_rl.tasks.task import Task, get_task, task_names

__all__ = ["Task", "get_task", "task_names"]
