"""Movers on maps of worlds: where they start, how they go on, and where they walk."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patches import Rectangle
from torch import Tensor

from rover_rl.rng import episode_keys, row_keys
from rover_rl.sims.movers.field import MoverField, shown_parts
from rover_rl.sims.rendering.scenery import Look, looks_of
from rover_rl.sims.settings import CONTROL_DT
from rover_rl.worlds import World
from rover_rl.worlds.movers import Motion, Rovers, Waypoints
from rover_rl.worlds.movers.parts import Parts, outlines
from rover_rl.worlds.region import Area
from rover_rl.worlds.table import WorldTable

SECONDS, HEAD = 2.0, 0.22
"""Duration of the way that is drawn of each mover, s, and length of the head of its arrow, m."""
AWAY = 1e4
"""Distance of the rover, to which movers may react, m."""
TINT, WAY = "#7c3aed", "#3b0764"
"""Color of the areas in which movers start and end, and of their ways."""
HATCHED: dict[str, Any] = {"hatch": "////", "linewidth": 0, "alpha": 0.35}
DOTTED: dict[str, Any] = {"linestyle": ":", "linewidth": 1.4, "alpha": 0.9}
EDGES: dict[str, Any] = {"edgecolors": "#14061f", "linewidths": 0.6}
"""Styles of these areas, and of the outlines of movers."""


def draw_movers(ax: Axes, world: World, seed: int = 0) -> None:
    """Draws the movers of a world where they start, with an arrow to where each is two seconds later.

    Dashed lines are the paths of motions that have one. Areas in which others start and end are hatched, and a dotted
    line bounds those in which they wander.
    """
    if not world.movers:
        return
    motions = [mover.motion for mover in world.movers]
    for names, style in ((("start", "goal"), HATCHED), (("area",), DOTTED)):
        for (x, right), (y, top) in dict.fromkeys(area for motion in motions for area in _areas(motion, names)):
            ax.add_patch(Rectangle((x, y), right - x, top - y, fill=False, edgecolor=TINT, zorder=2.5, **style))
    paths = [path for path in map(_path, motions) if path is not None]
    ax.add_collection(LineCollection(paths, colors=WAY, linewidths=1.0, linestyles="--", alpha=0.6, zorder=4.2))
    start, ways = _drive(world, seed)
    ax.add_collection(LineCollection(list(ways), colors=WAY, linewidths=1.1, zorder=4.4))
    ax.add_collection(PolyCollection(_heads(ways), facecolors=WAY, linewidths=0, zorder=4.4))
    if start is not None:
        ax.add_collection(PolyCollection(**parts_from_above(start, world), **EDGES, zorder=4.6))


def seen_from_above(
    kind: Tensor, half: Tensor, position: Tensor, orientation: Tensor, looks: Sequence[Look]
) -> dict[str, Any]:
    """Returns the outlines and the colors of parts as arguments of a ``PolyCollection``, the lowest first."""
    order = position[:, 2].argsort(stable=True)
    shapes = (values[order] for values in (kind, half, position, orientation))
    return {"verts": outlines(*shapes), "facecolors": [looks[part].color for part in order.tolist()]}


def parts_from_above(movers: Parts, world: World) -> dict[str, Any]:
    """Returns what :func:`seen_from_above` does of the parts of one row."""
    shapes = (movers.kind[0], movers.half[0], movers.position[0], movers.orientation[0])
    return seen_from_above(*shapes, looks_of(world, len(movers.kind[0])))


def _drive(world: World, seed: int) -> tuple[Parts | None, np.ndarray]:
    """Returns where movers start, and their ways, ``[M, steps, 2]`` (m)."""
    device = torch.device("cpu")
    field = MoverField(WorldTable([world]), CONTROL_DT, 0.0)
    rover, every = torch.full((1, 2), AWAY), torch.ones(1, 1, dtype=torch.bool)
    field.reset(every, episode_keys(row_keys(seed, 1, device), torch.ones(1, 1, dtype=torch.int64)), rover)
    start, ways = shown_parts(field, 0), [field.state.position[0]]
    for _ in range(round(SECONDS / CONTROL_DT)):
        field.advance(None, Rovers(rover[:, None], torch.zeros(1, 1, 2), 0.0))
        ways.append(field.state.position[0])
    return start, torch.stack(ways, 1).numpy()


def _heads(ways: np.ndarray) -> list[np.ndarray]:
    """Returns the heads of arrows at the ends of ways that are long enough."""
    heads = []
    for way in ways:
        ahead = way[-1] - way[-2]
        if np.linalg.norm(way[-1] - way[0]) > HEAD and (length := np.linalg.norm(ahead)) > 0:
            along, across = HEAD * ahead / length, HEAD / 2 * np.array((-ahead[1], ahead[0])) / length
            heads.append(np.array((way[-1] + along / 2, way[-1] - along / 2 + across, way[-1] - along / 2 - across)))
    return heads


def _areas(motion: Motion, names: Sequence[str]) -> list[Area]:
    places = [getattr(motion, name, None) for name in names]
    return [cast(Area, place) for place in places if place is not None and isinstance(place[0], Sequence)]


def _path(motion: Motion) -> np.ndarray | None:
    """Returns the path of a motion that has one, ``[points, 2]``, m."""
    if isinstance(motion, Waypoints):
        return np.array(motion.keys)[:, 1:3]
    ends = [getattr(motion, name, None) for name in ("start", "goal")]
    if any(end is None or isinstance(end[0], Sequence) for end in ends):
        return None
    return np.array(ends)
