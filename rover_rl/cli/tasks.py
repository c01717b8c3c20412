"""The command ``rover-rl tasks``."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from rover_rl.cli.options import Force
from rover_rl.cli.task_text import describe, listed
from rover_rl.files import check_outputs, written_whole
from rover_rl.tasks.task import Task, get_task, task_names

if TYPE_CHECKING:
    from rover_rl.robots import Robot
    from rover_rl.worlds import World


@dataclass(frozen=True)
class Tasks:
    """List the tasks and draw the first test world of each, or describe one task from top to bottom.

    docs/tasks.md has the rules of the test.
    """

    task: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="TASK")] = None
    """Task to describe: a name, or module:attribute. Default: list all."""
    out: Path | None = None
    """Picture to write. Default: tasks.png, and none of one task."""
    force: Force = False

    def __call__(self) -> int:
        tasks = [get_task(name) for name in ([self.task] if self.task else task_names())]
        out = self.out or (None if self.task else Path("tasks.png"))
        if out is not None:
            check_outputs(out, force=self.force)
        if self.task:
            print("\n".join(describe(tasks[0], self.task)))
        else:
            for task in tasks:
                print(f"{task.name:14}{listed(task.env.robot):16}{task.reason}")
            print("More about one: rover-rl tasks TASK. To learn it: rover-rl train TASK --learner NAME")
        if out is not None:
            from rover_rl.sims.free_space.draw import draw_tasks

            with written_whole(out) as temporary:
                draw_tasks([(_title(task), *first_test(task)) for task in tasks], temporary)
            print(f"drawn in {out}")
        return 0


def first_test(task: Task) -> tuple[World, Robot]:
    """Returns the first world and robot of a task's test."""
    from rover_rl.robots import get_robots
    from rover_rl.sims.free_space.fitting import fitting_worlds
    from rover_rl.worlds import get_world
    from rover_rl.worlds.pool import WorldPool

    env = task.test_env
    robot = get_robots(env.robot)[0]
    return get_world(fitting_worlds(WorldPool(*env.worlds).source(0), robot)), robot


def _title(task: Task) -> str:
    return "\n".join((task.name, *textwrap.wrap(task.reason, 40)))
