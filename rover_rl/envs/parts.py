"""Parts of an environment by name: actions, terminations, events and tasks. Does not import PyTorch.

Rewards, sensors, worlds, robots and backends have their registries where they are made.
"""

from __future__ import annotations

from typing import Any

from rover_rl.registry import Registry

HEADING = "heading"
"""Name of the contract's action."""

ACTIONS = Registry(
    "action",
    {
        HEADING: "rover_rl.envs.actions:Heading",
        "twist": "rover_rl.envs.actions:Twist",
        "wheels": "rover_rl.envs.actions:WheelSpeeds",
        "residual": "rover_rl.algos.policy.residual_action:RouteResidual",
    },
)
TERMINATIONS = Registry("termination", {"no_progress": "rover_rl.envs.terminations:NoProgress"})
EVENTS = Registry("event", {"power_dips": "rover_rl.envs.events:PowerDips"})
BUILT_IN_TASKS = {
    "inspect": "rover_rl.tasks.inspect:INSPECT",
    "moon": "rover_rl.tasks.moon:MOON",
    "maze": "rover_rl.tasks.maze:MAZE",
    "mazes": "rover_rl.tasks.mazes:MAZES",
    "rooms-people": "rover_rl.tasks.rooms_people:ROOMS_PEOPLE",
    "field": "rover_rl.tasks.field:FIELD",
    "depth": "rover_rl.tasks.depth:DEPTH",
    "hills": "rover_rl.tasks.hills:HILLS",
    "race": "rover_rl.tasks.race:RACE",
    "late": "rover_rl.tasks.late:LATE",
    "any-robot": "rover_rl.tasks.any_robot:ANY_ROBOT",
}
"""Tasks of the package, from easy to hard."""
TASKS = Registry("task", BUILT_IN_TASKS)


def register_action(name: str, action: Any) -> None:
    """Registers an :class:`Action` class, or its ``"module:attribute"``, for ``ActionConfig`` and ``--action``.

    Raises ``ValueError`` if the name is taken, or has other characters than letters, digits, ``_``, ``-`` and ``.``;
    so do the other functions that register a part.
    """
    ACTIONS.register(name, action)


def register_termination(name: str, termination: Any) -> None:
    """Registers a :class:`Termination`, a class or function that makes one, or its ``"module:attribute"``."""
    TERMINATIONS.register(name, termination)


def register_event(name: str, event: Any) -> None:
    """Registers an :class:`Event`, a class or function that makes one, or its ``"module:attribute"``."""
    EVENTS.register(name, event)


def register_task(name: str, task: Any) -> None:
    """Registers a :class:`~rover_rl.tasks.Task`, or its ``"module:attribute"``, for ``make_env`` and the commands."""
    TASKS.register(name, task)


def task_gym_id(name: str) -> str:
    """Returns the Gymnasium ID of a task: that of ``"rooms-people"`` is ``"rover_rl/RoomsPeople-v0"``."""
    return f"rover_rl/{''.join(word.capitalize() for word in name.split('-'))}-v0"
