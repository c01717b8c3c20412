"""Text of ``rover-rl tasks TASK``: a task from top to bottom."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any

from rover_rl.tasks.task import Task

WIDTH, INDENT = 110, 19
"""Width of a line, and of the names before it."""


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
