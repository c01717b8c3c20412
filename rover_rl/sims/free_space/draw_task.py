"""Map of a world with a start, a goal, and the shortest path between them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.lines import Line2D

from rover_rl.sims.free_space.draw import GOAL, SPAWN, add_legend, draw_world, map_legend
from rover_rl.sims.free_space.path_grid import PathGrid
from rover_rl.sims.free_space.shortest_paths import shortest_paths
from rover_rl.sims.free_space.space import FreeSpace, free_space
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds.draw import OBSTACLE_EDGE
from rover_rl.sims.worlds.world import World

CANDIDATES = 16
"""Number of goals, of which the farthest from the start is drawn."""
CAUTION = 1.0
"""Relative extra cost of the drawn path at obstacles: it keeps away from them where there is room."""
STEP = 3
"""Longest step of the drawn path, in cells."""


def draw_task(world: World, robot: Robot, seed: int, path: str | Path) -> float:
    """Draws a map of a world with a start, a goal and a path that the robot can drive.

    Args:
        world: world to draw.
        robot: robot for which the free space is computed.
        seed: seed of the start and the goal.
        path: image file, whose suffix selects the format.

    Returns:
        Length of the shortest path from the start to the goal, m.

    Raises:
        ValueError: if the world has no free space for the robot.
    """
    space, rng = free_space(world, robot), np.random.default_rng(seed)
    start = space.spawn_cells[int(rng.integers(len(space.spawn_cells)))]
    goals = space.goal_cells[torch.from_numpy(rng.integers(len(space.goal_cells), size=CANDIDATES))]
    goal = goals[int((goals - start).norm(dim=-1).argmax())]
    figure = draw_world(world, robot)
    ax = figure.axes[0]
    field = PathGrid(world, robot, CAUTION).costs(goal[None])[0].numpy()
    way = _descend(space, field, start.numpy())
    ax.plot(*way.T, color="white", linewidth=4.5, zorder=5)
    ax.plot(*way.T, color=OBSTACLE_EDGE, linewidth=2.2, zorder=6)
    marks: dict[str, Any] = {
        "marker": "o",
        "markeredgecolor": "white",
        "markersize": 15,
        "linestyle": "none",
        "zorder": 7,
    }
    places = [
        *ax.plot(*start.tolist(), color=SPAWN, label="start", **marks),
        *ax.plot(*goal.tolist(), color=GOAL, label="goal", **(marks | {"marker": "*"})),
    ]
    path_line = Line2D([], [], color=OBSTACLE_EDGE, linewidth=2.2, label="shortest path, with clearance")
    add_legend(ax, [*map_legend(world), *places, path_line])
    figure.savefig(path, dpi=150)
    return float(shortest_paths(world, robot, start[None], goal[None])[0])


def _descend(space: FreeSpace, field: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Returns the path that descends the distances to a goal from cell to cell: ``[P, 2]``, m."""
    passable = space.passable.numpy()
    column, row = np.rint((start - space.origin) / space.cell).astype(int)
    cells = [(row, column)]
    while True:
        rows, columns = (slice(max(0, k - STEP), k + STEP + 1) for k in cells[-1])
        near = np.where(passable[rows, columns], field[rows, columns], np.inf)
        best = np.unravel_index(near.argmin(), near.shape)
        cell = int(rows.start + best[0]), int(columns.start + best[1])
        if field[cell] >= field[cells[-1]]:
            return np.array(cells)[:, ::-1] * space.cell + space.origin
        cells.append(cell)
