"""Draws the pictures of the page about worlds: six layouts of each generator, as ``docs/images/generator_NAME.png``.

python docs/draw_generators.py
python docs/draw_generators.py forest rooms
"""

from __future__ import annotations

import sys
from io import BytesIO
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space
from rover_rl.sims.free_space.draw import FREE, GOAL
from rover_rl.sims.movers.draw import draw_movers
from rover_rl.worlds import WORLDS, World, get_world
from rover_rl.worlds.draw import draw_map
from rover_rl.worlds.region import Area, expanded, overlap, union

FOLDER = Path(__file__).parent / "images"
SEEDS, DIFFICULTIES = (1, 2), (0, 0.5, 1)
MARGIN, AROUND = 0.5, 6.0
"""Width of the margin around the floor, and of the ground shown around the task area, m."""
LEAST_HEIGHT = 3.0
"""Height of a picture from which on its titles have room, inches."""
COLORS = 160
"""Number of colors of a picture, which keeps its file small."""


def draw(name: str) -> Path:
    """Draws six layouts of a generator: a row for each seed, a column for each difficulty."""
    width, height = (high - low for low, high in _view(get_world(name)))
    figure = Figure(figsize=(10.2, max(LEAST_HEIGHT, 0.6 + 6.5 * height / width)), layout="constrained")
    axes = figure.subplots(len(SEEDS), len(DIFFICULTIES))
    for ax, (seed, difficulty) in zip(axes.flat, product(SEEDS, DIFFICULTIES), strict=True):
        _draw_layout(ax, f"{name}:{seed}@{difficulty:g}", seed)
    return _save(figure, FOLDER / f"generator_{name}.png")


def _view(world: World) -> Area:
    """Returns the area to show: the floor around the task area, and a margin."""
    shown = overlap(
        expanded(union(world.spawn_range, world.goal_range), AROUND), overlap(world.bounds, world.terrain.extent)
    )
    return expanded(shown, MARGIN)


def _draw_layout(ax: Axes, name: str, seed: int) -> None:
    """Draws the map of a world, the ground that the rover may enter, the task area, and movers as in a row's seed."""
    world = get_world(name)
    view = _view(world)
    draw_map(ax, world, view)
    free = free_space(world, get_robot("rover_zero"))
    rows, columns = free.passable.shape
    x, y = (low - free.cell / 2 for low in free.origin)
    extent = (x, x + columns * free.cell, y, y + rows * free.cell)
    passable = np.ma.masked_equal(free.passable.numpy(), False)
    ax.imshow(passable, ListedColormap([FREE]), alpha=0.16, origin="lower", extent=extent, zorder=1)
    ax.contour(free.passable.numpy(), levels=[0.5], colors=FREE, linewidths=0.7, origin="lower", extent=extent)
    for (x, right), (y, top) in {world.spawn_range, world.goal_range}:
        ax.add_patch(Rectangle((x, y), right - x, top - y, fill=False, edgecolor=GOAL, linestyle="--", zorder=4))
    draw_movers(ax, world, seed)
    ax.set_title(name, family="monospace", fontsize=10)
    ax.set(xlim=view[0], ylim=view[1], xlabel="", ylabel="")
    ax.tick_params(labelsize=7, length=2)


def _save(figure: Figure, path: Path) -> Path:
    image = BytesIO()
    figure.savefig(image, dpi=110)
    Image.open(image).convert("RGB").quantize(COLORS).save(path, optimize=True)
    return path


if __name__ == "__main__":
    for generator in sys.argv[1:] or WORLDS:
        print(draw(generator))
