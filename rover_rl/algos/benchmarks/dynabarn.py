"""DynaBARN: 60 yards with cylinders that move, 20 of each difficulty.

Nair et al., "DynaBARN: Benchmarking Metric Ground Navigation in Dynamic Environments", SSRR 2022. The worlds are in
https://github.com/Daffan/the-barn-challenge (MIT).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rover_rl.algos.benchmarks.moving import MotionFile, MovingSuite
from rover_rl.algos.benchmarks.suite import Course, open_world
from rover_rl.envs import EnvConfig
from rover_rl.worlds import Obstacle, boxes
from rover_rl.worlds.movers import Cylinder, Mover

START = (11.0, 0.0, math.pi)
"""x, y (m) and yaw (rad) of all starts."""
GOAL = (-9.0, 0.0)
"""x, y of all goals, m."""
GOAL_RADIUS = 1.0
"""Distance from the goal at which it is reached, m."""
SECONDS = 100.0
"""Time limit, s."""
HALF, WALL, HEIGHT = 10.0, 0.1, 1.0
"""Half the side of the yard, and thickness and height of its three walls, m. The side of the start is open."""
GROUPS = {"easy": 14, "medium": 19, "hard": math.inf}
"""Largest number of cylinders of each difficulty."""


def read_dynabarn(path: Path, worlds: Sequence[int] | None = None) -> list[Course]:
    """Reads worlds of DynaBARN.

    Args:
        path: JSON file with ``motions`` (by name: ``period``, s, and ``keys`` [t, x, y, yaw] in s, m and rad),
            ``worlds`` (by number, or a list: the names of the motions of its cylinders) and ``cylinder_radius`` (m).
        worlds: numbers of the worlds; ``None``: all that there are.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if a world is missing or wrong. The message is one sentence.
    """
    file = MotionFile.read(path)
    (radius,) = file.numbers([file.content.get("cylinder_radius")], 1, "cylinder_radius")
    return [_course(file, number, radius) for number in file.chosen(worlds)]


def _course(file: MotionFile, number: int, radius: float) -> Course:
    names = file.worlds[number]
    if not isinstance(names, list) or not names:
        raise ValueError(f"world {number} of {file.path} must be a list of motions")
    shape = Cylinder(radius, HEIGHT)
    movers = [Mover(file.motion(name), shape, f"cylinder {n}") for n, name in enumerate(names)]
    world = open_world(
        f"dynabarn-{number}", _walls(), np.array((START[:2], GOAL, (-HALF, HALF), (-HALF, -HALF))), movers
    )
    group = next(name for name, most in GROUPS.items() if len(names) <= most)
    return Course(number, world, START, GOAL, math.dist(START[:2], GOAL), group)


def _walls() -> list[Obstacle]:
    away, length = HALF + WALL / 2, 2 * (HALF + WALL)
    centers = [(-away, 0.0, HEIGHT / 2), (0.0, away, HEIGHT / 2), (0.0, -away, HEIGHT / 2)]
    return list(boxes(np.array(centers), np.array([(WALL, length, HEIGHT)] + [(2 * HALF, WALL, HEIGHT)] * 2)))


class DynaBarn(MovingSuite):
    """DynaBARN: success, what was hit, time-outs and time. The public score is not used: its path length is wrong.

    Args:
        courses: worlds, from :func:`read_dynabarn`.
        runs: number of runs in each world. All but the first start near the given start.
        seed: seed of these starts.
    """

    name, radius, limit = "DynaBARN", GOAL_RADIUS, SECONDS

    def original(self) -> tuple[str, str, str]:
        """Returns the name of the original, its robot and its lidar."""
        return self.name, "Jackal, chassis 0.42 x 0.31 m, 2 m/s", "as in BARN"

    def differences(self, env: EnvConfig) -> list[str]:
        """Returns how runs in an environment differ from the original benchmark."""
        yard = f"Yard: {2 * HALF:g} x {2 * HALF:g} m, three walls {HEIGHT:g} m high. Cylinders pass through walls."
        return [*super().differences(env), yard]
