"""The command ``rover-rl tasks``."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from rover_rl.cli.options import Force
from rover_rl.files import check_outputs, written_whole
from rover_rl.tasks.task import Task, get_task, task_names

if TYPE_CHECKING:
    from rover_rl.robots import Robot
    from rover_rl.worlds import World

WIDTH, INDENT = 110, 19  # width of a line, and of the names before it


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


def describe(task: Task, name: str) -> Iterator[str]:
    """Yields lines that describe a task, which the command line calls ``name``."""
    env, reward, ends = task.env, task.env.contract_reward, task.env.task
    # Penalties that are never due, and distances of those that are off.
    off = {"collision_penalty"} if ends.collision_window == 0 else set()
    off |= {f"{kind}_distance" for kind in ("clearance", "intrusion", "risk") if not getattr(reward, f"{kind}_penalty")}
    rewards = {key: value for key, value in vars(reward).items() if value and key not in off}
    bounds = {key: value for key, value in vars(env.bounded_action).items() if value and key != "kind"}
    varied = [_settings(_changed(part)) for part in (env.randomization, env.pose, env.limits)]
    lines = {
        "reason": task.reason,
        "a policy reads": listed(task.observation),
        "worlds": listed(env.world),
        "robot": listed(env.robot),
        "sensors": _joined(f"lidar of {_settings(vars(env.lidar))}", listed(env.sensors)),
        "action": f"{env.action.kind} within {_settings(bounds)}",
        "rewards": _joined(_settings(rewards), "" if env.reward == "contract" else listed(env.reward)),
        "terminations": _joined(_settings(vars(ends)), listed(env.terminate)),
        "events": _joined(listed(env.events), *varied) or "none",
        "length": f"{env.length:,} steps of {1000 * env.control_dt:g} ms",
        "test": f"{listed(task.test_world)}, {task.episodes} episodes in each, with {listed(task.test_env.robot)}",
        "success": f"the goal within {task.seconds:g} s, without a contact, by the mode of the policy",
        **{
            f"learner {learner}": f"rover-rl train {name} --learner {learner} ({_settings(settings) or 'defaults'})"
            for learner, settings in task.learners.items()
        },
        "references": f"rover-rl evaluate {' '.join((name, *task.references))}" if task.references else "none",
    }
    yield f"{task.name} ({task.gym_id} in Gymnasium)"
    for label, text in lines.items():
        yield from textwrap.wrap(f"  {label:{INDENT - 2}}{text}", WIDTH, subsequent_indent=INDENT * " ")


def _changed(part: Any) -> dict[str, Any]:
    return {one.name: value for one in fields(part) if (value := getattr(part, one.name)) != one.default}


def _settings(settings: Mapping[str, Any]) -> str:
    return ", ".join(f"{key}={_number(value)}" for key, value in settings.items() if value is not None)


def _number(value: Any) -> str:
    if isinstance(value, tuple):
        return f"({', '.join(map(_number, value))})"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def listed(value: Any) -> str:
    """Returns the names of one or several parts, with commas."""
    return ", ".join(map(str, value if isinstance(value, tuple) else (value,)))


def _joined(*parts: str) -> str:
    return "; ".join(filter(None, parts))
