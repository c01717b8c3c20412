"""JaxNav: single-agent levels in grids of 11 x 11 cells of 1 m.

Rutherford et al., "No Regrets: Investigating and Improving Regret Approximations for Curriculum Discovery", NeurIPS
2024 (https://github.com/amacrutherford/sampling-for-learnability, Apache-2.0). Goal radius and time limit are those of
``jaxnav_env.py`` in JaxMARL (0.3 m; 500 steps of 0.1 s).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from rover_rl.algos.benchmarks.suite import COLUMNS, Course, Result, Suite, open_world, read_arrays
from rover_rl.algos.evaluation.metrics import UNDEFINED, Estimate, ratio
from rover_rl.algos.evaluation.trajectory import Trajectory
from rover_rl.envs.config import EnvConfig
from rover_rl.worlds import boxes
from rover_rl.worlds.files.rectangles import cover

GOAL_RADIUS = 0.3  # distance from the goal at which it is reached, m
SECONDS = 50.0  # time limit, s
WALL_HEIGHT = 1.0  # height of the walls, m
WORST = 0.1  # share of the levels with the lowest success rates, whose success rate is reported apart
MAX_CELLS = 100  # largest number of cells along a side of a level


def read_jaxnav(path: Path) -> tuple[list[Course], int]:
    """Reads levels of JaxNav: those with a path from the start to the goal, and the number of the others.

    The ``.npz`` file has the arrays ``map_data [L, rows, columns]`` (1 is a wall), ``start_xy [L, 2]`` and
    ``goal_xy [L, 2]`` (cells of 1 m from the corner, so meters), ``start_theta [L]`` (rad) and ``geodesic8 [L]``
    (length of the shortest path over the cells and their eight neighbors, ``inf`` if there is none). Raises
    ``ValueError`` if the file is damaged, or a level is wrong.
    """
    pairs, single = (None, 2), (None,)
    shapes = {"map_data": (None, None, None), "start_xy": pairs, "start_theta": single, "goal_xy": pairs}
    arrays = read_arrays(path, {**shapes, "geodesic8": single})
    counts = {name: len(array) for name, array in arrays.items()}
    if len(set(counts.values())) > 1:
        raise ValueError(f"the arrays of {path} must have an entry for each level, got {counts}")
    solvable = np.flatnonzero(np.isfinite(arrays["geodesic8"])).tolist()
    if not solvable:
        raise ValueError(f"{path} has no level with a path from its start to its goal")
    return [_course(path, level, arrays) for level in solvable], counts["map_data"] - len(solvable)


def _course(path: Path, level: int, arrays: dict[str, np.ndarray]) -> Course:
    what, cells = f"level {level} of {path}", arrays["map_data"][level]
    if not (np.isin(cells, (0, 1)).all() and min(cells.shape) >= 3 and max(cells.shape) <= MAX_CELLS):
        raise ValueError(f"the map of {what} must be 0 or 1 in 3 x 3 to {MAX_CELLS} x {MAX_CELLS} cells")
    walls = cells == 1
    if not (walls[[0, -1]].all() and walls[:, [0, -1]].all()):
        raise ValueError(f"the map of {what} must have walls all around")
    start, goal = (arrays[key][level].astype(float) for key in ("start_xy", "goal_xy"))
    yaw, length = (float(arrays[key][level]) for key in ("start_theta", "geodesic8"))
    size = np.array(walls.shape[::-1])
    for name, (x, y) in (("start", start), ("goal", goal)):
        inside = 0 <= x < size[0] and 0 <= y < size[1]
        if not inside or walls[int(y), int(x)]:
            raise ValueError(f"the {name} ({x:g}, {y:g}) of {what} is not in a free cell")
    if not math.isfinite(yaw) or length < 0:
        raise ValueError(f"{what} must have a finite start_theta and a geodesic8 of at least 0, got {yaw} and {length}")
    rectangles = np.array(cover(walls), dtype=float)
    corners, sides = rectangles[:, 1::-1], rectangles[:, :1:-1]
    heights = np.full((len(rectangles), 1), WALL_HEIGHT)
    obstacles = boxes(np.hstack((corners + sides / 2, heights / 2)), np.hstack((sides, heights)))
    world = open_world(f"jaxnav-{level}", obstacles, np.vstack((np.zeros(2), size)))
    # The distance between cells may be less than the straight line from the start to the goal.
    return Course(level, world, (*start.tolist(), yaw), (*goal.tolist(),), max(length, math.dist(start, goal)))


@dataclass(kw_only=True)
class JaxNav(Suite):
    """JaxNav: success, SPL, and the success in the worst 10 % of the levels, which come from :func:`read_jaxnav`.

    The worst levels are chosen by the even runs (from 0), by success and then by SPL, and their success is that of the
    odd runs: a choice by the same runs would be biased by chance. So it takes two runs or more.
    """

    name = "JaxNav"
    score_name = "spl"
    places = "levels"
    columns: ClassVar = {**COLUMNS, "spl": ("SPL", ""), "worst_levels": ("worst 10 %", "%")}
    worlds = "JaxNav levels in this simulator."
    robot = ", with skidding wheels (JaxNav: a square of 0.5 m, 1 m/s, without skidding)"
    lidar = "200 beams in 360 degrees, up to 6 m"

    unsolvable: int = 0  #: Number of levels that are left out because they have no path.
    goal_radius: float = GOAL_RADIUS
    seconds: float = SECONDS

    def score(self, course: Course, run: Trajectory) -> float:
        shortest = max(course.length - self.goal_radius, 0.0)
        return (run.ending == "goal") * shortest / max(run.length, shortest, 1e-9)

    def metrics(self, result: Result) -> dict[str, Estimate]:
        worst = UNDEFINED
        if self.runs > 1:
            success, scores = result.succeeded, result.scores
            choice = list(zip(success[:, ::2].mean(1).tolist(), scores[:, ::2].mean(1).tolist(), strict=True))
            levels = sorted(range(len(choice)), key=lambda level: choice[level])[: math.ceil(WORST * len(choice))]
            worst = ratio(success[levels][:, 1::2].mean(1).tolist())
        return {**super().metrics(result), "worst_levels": worst}

    def differences(self, env: EnvConfig) -> list[str]:
        spl = "SPL: relative to the shortest path over the cells and their eight neighbors, less the goal radius."
        mine, theirs = f"{self.goal_radius:g} m and {self.seconds:g} s", f"{GOAL_RADIUS:g} m and {SECONDS:g} s"
        limits = f"Limits: goal radius {mine} (JaxNav: {theirs})."
        few = "The worst 10 % of the levels need two runs or more: half choose them, half score them."
        out = f"Left out: {self.unsolvable} levels without a path from the start to the goal."
        others = {limits: mine != theirs, few: self.runs < 2, out: self.unsolvable}
        return [*super().differences(env), spl, *(text for text, applies in others.items() if applies)]
