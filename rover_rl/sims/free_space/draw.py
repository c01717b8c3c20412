"""Maps of worlds with the free space of a robot, the areas of the task, and a path."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from scipy import ndimage

from rover_rl.robots import Robot
from rover_rl.sims.free_space.cells import cells_of
from rover_rl.sims.free_space.paths import PathGrid, shortest_paths
from rover_rl.sims.free_space.space import free_space
from rover_rl.sims.movers.draw import SECONDS, WAY, draw_movers
from rover_rl.worlds.draw import OBSTACLE, OBSTACLE_EDGE, draw_map
from rover_rl.worlds.region import Area, Region, expanded, overlap, union
from rover_rl.worlds.world import World

MARGIN = 3.0
"""Width of the margin around the bounds of the world, m."""
FREE, CUT_OFF, SPAWN, GOAL, BOUNDS = "#2a9d8f", "#86198f", "#1d4ed8", "#f97316", "#b91c1c"
USED, UNUSED = 0.5, 0.16
"""Opacity of the free ground with and without starts and goals."""
LEGEND_WIDTH = 7.2
"""Least width of a figure, so that the legend fits, inches."""
DASHES = (0, (3, 3))
"""Line of the goal area, so that both outlines are visible where they coincide."""
CANDIDATES = 16
"""Number of goals, of which :func:`draw_task` draws the farthest from the start."""
CAUTION = 1.0
"""Relative extra cost of the drawn path at obstacles: it keeps away from them where there is room."""


def draw_world(world: World, robot: Robot, path: str | Path | None = None, ax: Axes | None = None) -> Figure:
    """Draws a map of a world: ground, obstacles, the free space of a robot, and the areas of the task.

    ``path`` is that of the image file, whose suffix selects the format; ``None`` does not save the figure. ``None`` as
    ``ax`` creates a new figure.
    """
    view = _view(world)
    if ax is None:
        width, height = (high - low for low, high in view)
        ax = Figure(figsize=(max(LEGEND_WIDTH, 5.2 * width / height + 1.6), 7.0), layout="constrained").add_subplot()
    figure: Any = ax.figure
    colors = draw_map(ax, world, view)
    if colors is not None:
        figure.colorbar(colors, ax=ax, label="elevation (m)", shrink=0.75, pad=0.02, extend="both")
    _draw_free_space(ax, world, robot)
    _outline(ax, world.bounds, edgecolor=BOUNDS, linestyle=(0, (6, 4)), linewidth=1.4)
    _draw_area(ax, world.spawn_range, world.spawn_region, SPAWN, "solid")
    _draw_area(ax, world.goal_range, world.goal_region, GOAL, DASHES)
    draw_movers(ax, world)
    ax.set_title(f"{world.name}: where {robot.name} can drive")
    _add_legend(ax, world)
    if path is not None:
        figure.savefig(path, dpi=150)
    return figure


def _view(world: World) -> Area:
    return overlap(expanded(world.bounds, MARGIN), expanded(world.terrain.extent, 0.5))


def _draw_free_space(ax: Axes, world: World, robot: Robot) -> None:
    """Draws which free ground has starts or goals, which the rover can only drive over, and which it cannot reach."""
    free = free_space(world, robot)
    passable = free.passable.numpy()
    used = np.zeros_like(passable)
    for cells in (free.spawn_cells, free.goal_cells):
        used[cells_of(free, cells)] = True
    parts, _ = ndimage.label(passable, np.ones((3, 3)))
    reached = np.isin(parts, np.unique(parts[used & passable]))
    colors = np.zeros((*passable.shape, 4))
    colors[passable] = to_rgba(CUT_OFF, 2 * UNUSED)
    colors[reached] = to_rgba(FREE, UNUSED)
    colors[used] = to_rgba(FREE, USED)
    extent = _extent(free.origin, free.cell, passable)
    ax.imshow(colors, origin="lower", extent=extent, interpolation="nearest", zorder=1)
    ax.contour(reached, levels=[0.5], colors=FREE, linewidths=0.8, origin="lower", extent=extent, zorder=2)


def _extent(center: tuple[float, float], cell: float, cells: np.ndarray) -> tuple[float, float, float, float]:
    """Left, right, bottom and top of a grid of cells, of which the first has its center at ``center``, m."""
    (left, bottom), (rows, columns) = (middle - cell / 2 for middle in center), cells.shape
    return left, left + columns * cell, bottom, bottom + rows * cell


def _draw_area(ax: Axes, area: Area, region: Region | None, color: str, line: Any) -> None:
    if region is None:
        _outline(ax, area, edgecolor=color, linestyle=line, linewidth=2.2)
        return
    mask = np.pad(region.mask.numpy(), 1)
    x, y = region.origin
    extent = _extent((x - region.cell / 2, y - region.cell / 2), region.cell, mask)
    style: dict[str, Any] = {"colors": color, "linestyles": [line], "linewidths": 2.2, "zorder": 4}
    ax.contour(mask, levels=[0.5], origin="lower", extent=extent, **style)


def _outline(ax: Axes, area: Area, **style: Any) -> None:
    (x, right), (y, top) = area
    ax.add_patch(Rectangle((x, y), right - x, top - y, fill=False, zorder=4, **style))


def _add_legend(ax: Axes, world: World, *more: Line2D) -> None:
    """Puts a legend with ``more`` entries below a map of :func:`draw_world`, in the place of the one that it has."""
    visible = overlap(world.bounds, _view(world)) == world.bounds
    handles = [
        Patch(facecolor=to_rgba(FREE, USED), edgecolor=FREE, label="free: starts, goals"),
        Patch(facecolor=to_rgba(FREE, UNUSED), edgecolor=FREE, label="free: only driven over"),
        Patch(facecolor=to_rgba(CUT_OFF, 2 * UNUSED), label="free, but out of reach"),
        Patch(facecolor=OBSTACLE, edgecolor=OBSTACLE_EDGE, label="obstacle"),
        Line2D([], [], color=SPAWN, linewidth=2.2, label="start area"),
        Line2D([], [], color=GOAL, linewidth=2.2, linestyle=(0, (2, 1)), label="goal area"),
        Line2D([], [], color=BOUNDS, linestyle="--", label="bounds" if visible else "bounds (beyond the map)"),
    ]
    if world.movers:
        label = f"mover, and {SECONDS:g} s of its way"
        handles.append(Line2D([], [], color=WAY, marker="o", markersize=7, label=label))
    style: dict[str, Any] = {"ncols": 3, "frameon": False, "handlelength": 1.8, "columnspacing": 1.4}
    ax.legend(handles=[*handles, *more], loc="upper center", bbox_to_anchor=(0.5, -0.09), **style)


def draw_task(world: World, robot: Robot, seed: int, path: str | Path) -> float:
    """Draws a map with a start and a goal by a seed and a path between them. Returns the length of the shortest, m.

    Raises:
        ValueError: if the world has no free space for the robot.
    """
    figure = draw_world(world, robot)
    ax = figure.axes[0]
    length, places = _draw_way(ax, world, robot, seed)
    line = Line2D([], [], color=OBSTACLE_EDGE, linewidth=2.2, label="shortest path, with clearance")
    _add_legend(ax, world, *places, line)
    figure.savefig(path, dpi=150)
    return length


def draw_tasks(panels: Sequence[tuple[str, World, Robot]], path: str | Path, columns: int = 4, seed: int = 0) -> None:
    """Draws maps side by side, with a title each, and a start and a goal of the robot with a path between them."""
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(3.1 * columns, 3.75 * rows))
    figure.set_layout_engine("constrained", h_pad=0.09)
    axes = [*figure.subplots(rows, columns, squeeze=False).flat]
    for ax, (title, world, robot) in zip(axes, panels, strict=False):
        draw_map(ax, world)
        draw_movers(ax, world)
        _draw_way(ax, world, robot, seed, size=11)
        # The areas of the task, and the path, which may lead around.
        shown = union(union(world.spawn_range, world.goal_range), _extent_of(ax.lines))
        x, y = overlap(expanded(shown, MARGIN / 2), world.terrain.extent)
        ax.set(xlim=x, ylim=y, xticks=[], yticks=[], xlabel="", ylabel="")
        ax.set_title(title, fontsize=8.5)
    for ax in axes[len(panels) :]:
        ax.remove()
    figure.savefig(path, dpi=100)


def _extent_of(lines: Iterable[Line2D]) -> Area:
    points = np.concatenate([line.get_xydata() for line in lines])
    (left, bottom), (right, top) = points.min(0).tolist(), points.max(0).tolist()
    return (left, right), (bottom, top)


def _draw_way(ax: Axes, world: World, robot: Robot, seed: int, size: float = 15) -> tuple[float, list[Line2D]]:
    """Draws a start, a goal and a path between them. Returns the length of the shortest, m, and the marks."""
    space, rng = free_space(world, robot), np.random.default_rng(seed)
    start = space.spawn_cells[int(rng.integers(len(space.spawn_cells)))]
    goals = space.goal_cells[torch.from_numpy(rng.integers(len(space.goal_cells), size=CANDIDATES))]
    goal = goals[int((goals - start).norm(dim=-1).argmax())]
    way = PathGrid(world, robot, CAUTION).path(start, goal)
    ax.plot(*way.T, color="white", linewidth=4.5, zorder=5)
    ax.plot(*way.T, color=OBSTACLE_EDGE, linewidth=2.2, zorder=6)
    marks: dict[str, Any] = {"markeredgecolor": "white", "markersize": size, "linestyle": "none", "zorder": 7}
    places = [
        *ax.plot(*start.tolist(), color=SPAWN, label="start", marker="o", **marks),
        *ax.plot(*goal.tolist(), color=GOAL, label="goal", marker="*", **marks),
    ]
    return float(shortest_paths(world, robot, start[None], goal[None])[0]), places
