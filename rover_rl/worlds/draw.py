"""Maps of worlds, drawn with Matplotlib's object-oriented interface. Needs no display."""

from __future__ import annotations

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import LightSource, LinearSegmentedColormap, Normalize
from matplotlib.patches import Rectangle

from rover_rl.worlds.region import Area, overlap
from rover_rl.worlds.world import World

GROUND = LinearSegmentedColormap.from_list("ground", ["#4d4038", "#86694f", "#b8946a", "#d9c094", "#f1e6cb"])
LEVEL = "#e6dcc3"
OBSTACLE, OBSTACLE_EDGE = "#39424e", "#161a20"


def draw_map(ax: Axes, world: World, area: Area | None = None) -> ScalarMappable | None:
    """Draws the ground and the obstacles of a world in an area (m; ``None``: all of the terrain), and sets the limits.

    Returns:
        Color scale of the elevation (m), for a color bar. ``None`` if the ground is flat.
    """
    area = area or world.terrain.extent
    shown = overlap(area, world.terrain.extent)
    elevation = None
    if world.terrain.is_flat:
        (x, right), (y, top) = shown
        ax.add_patch(Rectangle((x, y), right - x, top - y, facecolor=LEVEL, zorder=0))
    else:
        elevation = _draw_ground(ax, world, shown)
    outlines = [obstacle.footprint.numpy() for obstacle in world.obstacles]
    ax.add_collection(PolyCollection(outlines, facecolor=OBSTACLE, edgecolor=OBSTACLE_EDGE, linewidth=0.6, zorder=3))
    ax.set(xlim=area[0], ylim=area[1], aspect="equal", xlabel="x (m)", ylabel="y (m)")
    return elevation


def _draw_ground(ax: Axes, world: World, area: Area) -> ScalarMappable:
    step = world.terrain.cell / 2
    x, y = (torch.arange(low + step / 2, high, step, dtype=torch.float64) for low, high in area)
    grid_y, grid_x = torch.meshgrid(y, x, indexing="ij")
    heights = world.height_at(torch.stack((grid_x, grid_y), -1)).numpy()
    # Quantiles instead of extremes: a single pit would otherwise reduce the contrast of the rest.
    norm = Normalize(*np.quantile(heights, (0.02, 0.98)))
    light = LightSource(azdeg=315, altdeg=45)
    # The light source expects the first row at the top of the image, where y is largest.
    image = light.shade(heights[::-1], GROUND, blend_mode="soft", vert_exag=2.5, dx=step, dy=step, norm=norm)
    ax.imshow(image, extent=(*area[0], *area[1]), interpolation="bilinear", zorder=0)
    return ScalarMappable(norm, GROUND)
