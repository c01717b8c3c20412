"""ros_jackal: 10 m among moving boxes, or past two sliding walls in a field of cylinders.

Xu et al., "Benchmarking Reinforcement Learning Techniques for Autonomous Navigation", ICRA 2023
(https://github.com/Daffan/ros_jackal, MIT).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rover_rl.algos.benchmarks.moving import MotionFile, MovingSuite
from rover_rl.algos.benchmarks.suite import Course, open_world
from rover_rl.envs import EnvConfig
from rover_rl.envs.specs import action_bounds
from rover_rl.worlds import Obstacle, cylinders
from rover_rl.worlds.movers import Box, Mover

START = (-2.0, 3.0, 1.57)
"""x, y (m) and yaw (rad) of all starts."""
GOAL = (-2.0, 13.0)
"""x, y of all goals, m."""
GOAL_RADIUS = 0.4
"""Distance from the goal at which it is reached, m."""
SECONDS = 80.0
"""Time limit, s: 400 steps of 0.2 s."""
HEIGHT = 1.0
"""Height of the cylinders that do not move, m."""
FIRST_WALLS = 400
"""Number of the first world with sliding walls. Those before have boxes."""
PUBLISHED = "Published: boxes 52 +- 1 % (transformer), 50 +- 5 % (MLP); walls 82 +- 4 % (GRU), at 2 m/s."
"""Success of the original."""


def read_ros_jackal(path: Path, worlds: Sequence[int] | None = None) -> list[Course]:
    """Reads worlds of ros_jackal.

    Args:
        path: JSON file with ``motions`` (by name: ``period``, s, and ``keys`` [t, x, y, yaw] in s, m and rad) and
            ``worlds`` by number: ``movers`` (each a ``motion`` and the ``size`` of a box, m) and ``static_cylinders``
            (x, y and radius, m).
        worlds: numbers of the worlds; ``None``: all that there are.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if a world is missing or wrong. The message is one sentence.
    """
    file = MotionFile.read(path)
    return [_course(file, number) for number in file.chosen(worlds)]


def _course(file: MotionFile, number: int) -> Course:
    what, found = f"world {number} of {file.path}", file.worlds[number]
    if not isinstance(found, dict) or not isinstance(found.get("movers"), list):
        raise ValueError(f"{what} must have movers")
    movers = []
    for k, mover in enumerate(found["movers"]):
        if not isinstance(mover, dict):
            raise ValueError(f"mover {k} of {what} must have a motion and a size")
        size = file.numbers(mover.get("size"), 3, f"the size of mover {k} of world {number}")
        movers.append(Mover(file.motion(mover.get("motion")), Box(*size), f"box {k}"))
    given = [file.numbers(row, 3, f"a cylinder of world {number}") for row in found.get("static_cylinders") or []]
    fixed = np.array(given).reshape(-1, 3)
    points = np.vstack((START[:2], GOAL, fixed[:, :2]))
    world = open_world(f"ros-jackal-{number}", _cylinders(fixed), points, movers)
    group = "boxes" if number < FIRST_WALLS else "walls"
    return Course(number, world, START, GOAL, math.dist(START[:2], GOAL), group)


def _cylinders(rows: np.ndarray) -> list[Obstacle]:
    found: list[Obstacle] = []
    for radius in np.unique(rows[:, 2]).tolist():
        centers = rows[rows[:, 2] == radius, :2]
        found += cylinders(np.column_stack((centers, np.full(len(centers), HEIGHT / 2))), radius, HEIGHT)
    return found


class RosJackal(MovingSuite):
    """ros_jackal: success, what was hit, time-outs and time.

    Args:
        courses: worlds, from :func:`read_ros_jackal`.
        runs: number of runs in each world. All but the first start near the given start.
        seed: seed of these starts.
    """

    name, radius, limit = "ros_jackal", GOAL_RADIUS, SECONDS

    def original(self) -> tuple[str, str, str]:
        """Returns the name of the original, its robot and its lidar."""
        return self.name, "Jackal, chassis 0.42 x 0.31 m, -1 to 2 m/s", "720 beams, up to 5 m"

    def differences(self, env: EnvConfig) -> list[str]:
        """Returns how runs in an environment differ from the original benchmark."""
        told = super().differences(env)
        if action_bounds(env.bounded_action).high[0] <= 1.0:
            told.append(
                "Sliding walls of 1.0 to 1.5 m/s cannot be passed at 1 m/s: those worlds are for a faster robot."
            )
        return [*told, PUBLISHED]
