"""Movers in pictures of driven paths."""

from __future__ import annotations

import math

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D

from rover_rl.algos.evaluation.trajectory import Trajectory
from rover_rl.sims.movers.draw import EDGES, WAY, seen_from_above
from rover_rl.sims.rendering.looks import looks_of
from rover_rl.sims.rendering.scenery import MOVER
from rover_rl.worlds import World

TRACE = 3.0
"""Duration for which the movers of an episode leave a trace before its end, s."""
NEAR = 1.5
"""Distance from the rover at the end of an episode up to which movers are drawn among other episodes, m."""


def draw_mover_traces(ax: Axes, world: World, trajectory: Trajectory, alone: bool) -> None:
    """Draws where the movers of an episode are at its end, with fading traces, if the trajectory has them.

    Of an episode among others, only those near the rover that has not reached its goal.
    """
    track, reached = trajectory.movers, trajectory.ending == "goal"
    if track is None or not len(track.position) or (reached and not alone):
        return
    gaps = (track.position[-1, :, :2] - trajectory.path[-1]).norm(dim=-1) - track.half[:, :2].amax(-1)
    shown = track.mover[gaps < (math.inf if alone else NEAR)].unique()
    for mover in shown.tolist():
        parts = (track.mover == mover).nonzero().squeeze(-1)
        # The last part is the trunk of a person, whose legs swing.
        way = track.position[-1 - round(TRACE / trajectory.dt) :, parts[-1], :2].numpy()
        colors = [(*to_rgb(WAY), share) for share in np.linspace(0, 0.8, len(way) - 1)]
        segments = list(np.stack((way[:-1], way[1:]), 1))
        ax.add_collection(LineCollection(segments, colors=colors, linewidths=1.6, zorder=4.2))
    drawn = torch.isin(track.mover, shown)
    looks = [look for look, is_drawn in zip(looks_of(world, len(drawn)), drawn.tolist(), strict=True) if is_drawn]
    position, orientation = track.position[-1, drawn], track.orientation[-1, drawn]
    shapes = seen_from_above(track.kind[drawn], track.half[drawn], position, orientation, looks)
    ax.add_collection(PolyCollection(**shapes, **EDGES, alpha=0.85, zorder=4.4))


def mover_handle() -> Line2D:
    return Line2D([], [], color=WAY, marker="o", markerfacecolor=MOVER, label=f"mover at the end, its last {TRACE:g} s")
