"""Figures of training runs, driven paths and rewards, in colors that color-blind readers can tell apart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import ListedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.algos.driving import CONTACT, ENDINGS, TIME_LIMIT
from rover_rl.algos.evaluation.results import Evaluation, worst_worlds
from rover_rl.algos.evaluation.trajectory import Trajectory
from rover_rl.envs.task import StepEvent
from rover_rl.files import written_whole
from rover_rl.sims.movers.draw import EDGES, WAY, seen_from_above
from rover_rl.sims.rendering.scenery import MOVER, looks_of
from rover_rl.sims.settings import CONTROL_DT
from rover_rl.worlds import World
from rover_rl.worlds.draw import draw_map
from rover_rl.worlds.world import Area

BLUE, ORANGE, GREEN, PURPLE, RED, SKY = "#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9"
GREY, GRID = "#6b7280", "#e5e7eb"
TRACE = 3.0  # duration for which the movers of an episode leave a trace before its end, s
NEAR = 1.5  # distance from the rover at the end of an episode up to which movers are drawn among other episodes, m
_MAX_COLUMNS = 3  # largest number of panels in a row
_STRIDE = 4  # Number of steps per segment of a path. Its color shows the mean speed over them.
_SPEED = ScalarMappable(Normalize(0, 1), ListedColormap(colormaps["plasma_r"](np.linspace(0.12, 1, 256))))
"""Colors of speeds in m/s, bright for low speeds, without the brightest yellow: it is hard to see on pale ground."""


def style_axes(ax: Axes) -> None:
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(axis="y", color=GRID)
    ax.set_axisbelow(True)


def draw_paths(evaluations: Sequence[Evaluation], path: Path, max_episodes: int = 32) -> None:
    """Draws driven paths from above, colored by speed, with a panel per policy, of the first ``max_episodes`` at most.

    Of several worlds, the six with the lowest success rates are drawn, with a panel per policy and world. The suffix of
    ``path`` selects the format.
    """
    episodes = evaluations[0].episodes
    if not episodes.several_worlds:
        shown = range(len(episodes))[:max_episodes]
        first = f"\nfirst {max_episodes} shown" if len(episodes) > max_episodes else ""
        panels = [(f"{one.name}: success rate {one.success_rate:.0%}", one.select(shown)) for one in evaluations]
        draw_panels(panels, path, f"{evaluations[0].title}{first}")
        return
    panels, worst = [], worst_worlds(evaluations)
    for evaluation in evaluations:
        rates = {world["world"]: world["success_rate"] for world in evaluation.by_world}
        for world in worst:
            members = (episodes.world_index == world).nonzero().squeeze(-1).tolist()[:max_episodes]
            title = f"{evaluation.name}, {episodes.world_name(members[0])}: {rates[world]:.0%}"
            panels.append((title, evaluation.select(members)))
    title = f"{episodes.name}: the worlds with the lowest success rates"
    draw_panels(panels, path, title, columns=_MAX_COLUMNS if len(evaluations) == 1 else len(worst))


def draw_panels(panels: Sequence[tuple[str, Evaluation]], path: Path, title: str, columns: int = _MAX_COLUMNS) -> None:
    """Draws driven paths from above, colored by speed, in panels with a title and an evaluation in one world each."""
    rows = math.ceil(len(panels) / columns)
    columns = math.ceil(len(panels) / rows)
    figure = Figure(figsize=(4 * columns + 0.8, 4.3 * rows + 1.2), layout="compressed")
    figure.suptitle(title)
    # Panels with the same world show the same area.
    points: dict[World, list[Tensor]] = {}
    for _, evaluation in panels:
        points.setdefault(evaluation.episodes.world, []).extend((*evaluation.paths, evaluation.episodes.goal))
    for number, (name, evaluation) in enumerate(panels, 1):
        ax = figure.add_subplot(rows, columns, number)
        _draw_evaluation(ax, evaluation, _square_around(torch.cat(points[evaluation.episodes.world])))
        ax.set(xlabel="", ylabel="")
        ax.set_title(name, fontsize="medium")
    axes = list(figure.axes)
    figure.colorbar(_SPEED, ax=axes, label="speed over ground (m/s)", shrink=0.7, pad=0.01, extend="max")
    driven = [trajectory for _, evaluation in panels for trajectory in evaluation.trajectories]
    ends = {f"end: {kind}": style for kind, style in _end_styles(driven).items()}
    marks = {"start": _START, "goal": _GOAL, **ends}
    handles: list[Artist] = [axes[0].scatter([], [], label=label, **style) for label, style in marks.items()]
    if any(trajectory.movers is not None for trajectory in driven):
        label = f"mover at the end, its last {TRACE:g} s"
        handles.append(Line2D([], [], color=WAY, marker="o", markerfacecolor=MOVER, label=label))
    figure.legend(handles=handles, loc="outside lower center", ncols=3 * columns, frameon=False)
    save_figure(figure, path)


def save_figure(figure: Figure, path: Path) -> None:
    with written_whole(path) as temporary:
        figure.savefig(temporary, dpi=150)


def _square_around(points: Tensor, margin: float = 0.7) -> Area:
    low, high = points.amin(0), points.amax(0)
    center, half = (low + high) / 2, (high - low).max() / 2 + margin
    (left, bottom), (right, top) = (center - half).tolist(), (center + half).tolist()
    return (left, right), (bottom, top)


def _draw_evaluation(ax: Axes, evaluation: Evaluation, area: Area) -> None:
    episodes, driven = evaluation.episodes, evaluation.trajectories
    draw_pale_map(ax, episodes.world, area)
    for trajectory in driven:
        _draw_mover_traces(ax, episodes.world, trajectory, alone=len(driven) == 1)
    segments, speeds = map(np.concatenate, zip(*map(_segments, driven), strict=True))
    colors = _SPEED.to_rgba(speeds)
    ax.add_collection(LineCollection(list(segments), colors=colors, linewidths=1.8, capstyle="round", zorder=4))
    ax.scatter(*episodes.goal.T, zorder=5, **_GOAL)
    ax.scatter(*episodes.start[:, :2].T, zorder=6, **_START)
    for ending, style in _end_styles(driven).items():
        ends = [trajectory.path[-1].tolist() for trajectory in driven if trajectory.ending == ending]
        ax.scatter(*np.array(ends).T, zorder=7, **style)


def _end_styles(driven: Sequence[Trajectory]) -> dict[str, dict[str, Any]]:
    """Styles of the marks of the endings of drives, those of one's own last."""
    endings = {trajectory.ending for trajectory in driven}
    own = {ending: {"marker": "p", **_EARLY} for ending in sorted(endings - {*_ENDS})}
    return {ending: style for ending, style in (_ENDS | own).items() if ending in endings}


def _draw_mover_traces(ax: Axes, world: World, trajectory: Trajectory, alone: bool) -> None:
    """Draws movers at the end of an episode, with fading traces; among other episodes, those near a failed rover."""
    track, reached = trajectory.movers, trajectory.ending == "goal"
    if track is None or not len(track.position) or (reached and not alone):
        return
    gaps = (track.position[-1, :, :2] - trajectory.path[-1]).norm(dim=-1) - track.half[:, :2].amax(-1)
    shown = track.mover[gaps < (math.inf if alone else NEAR)].unique()
    for mover in shown.tolist():
        # The last part is the trunk of a person, whose legs swing.
        part = (track.mover == mover).nonzero()[-1, 0]
        way = track.position[-1 - round(TRACE / trajectory.dt) :, part, :2].numpy()
        colors = [(*to_rgb(WAY), share) for share in np.linspace(0, 0.8, len(way) - 1)]
        segments = list(np.stack((way[:-1], way[1:]), 1))
        ax.add_collection(LineCollection(segments, colors=colors, linewidths=1.6, zorder=4.2))
    drawn = torch.isin(track.mover, shown)
    looks = [look for look, is_drawn in zip(looks_of(world, len(drawn)), drawn.tolist(), strict=True) if is_drawn]
    position, orientation = track.position[-1, drawn], track.orientation[-1, drawn]
    shapes = seen_from_above(track.kind[drawn], track.half[drawn], position, orientation, looks)
    ax.add_collection(PolyCollection(**shapes, **EDGES, alpha=0.85, zorder=4.4))


def draw_pale_map(ax: Axes, world: World, area: Area) -> None:
    """Draws a map with a paler ground, on which paths are easier to see."""
    draw_map(ax, world, area)
    ax.add_patch(Rectangle((0, 0), 1, 1, transform=ax.transAxes, color="white", alpha=0.4, linewidth=0, zorder=1))


def _segments(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Segments of a path, ``[segments, 2, 2]`` (m), and the mean speed on each, ``[segments]`` (m/s)."""
    steps = np.unique(np.append(np.arange(0, len(trajectory), _STRIDE), len(trajectory)))
    points, driven = trajectory.path.numpy()[steps], np.cumsum(np.append(0.0, trajectory.speed.numpy()))
    return np.stack((points[:-1], points[1:]), 1), np.diff(driven[steps]) / np.diff(steps)


_START: dict[str, Any] = {"s": 24, "color": "white", "edgecolor": "black", "linewidth": 1.0}
_GOAL: dict[str, Any] = {"s": 90, "marker": "*", "color": GREEN, "edgecolor": "black", "linewidth": 0.6}
_EARLY: dict[str, Any] = {"s": 60, "color": "black", "edgecolor": "white", "linewidth": 0.8}
_ENDS: dict[str, dict[str, Any]] = {
    ENDINGS[StepEvent.GOAL]: {"s": 30, "color": GREEN, "edgecolor": "white", "linewidth": 0.8},
    TIME_LIMIT: {"s": 30, "marker": "s", "color": "white", "edgecolor": "black", "linewidth": 1.3},
    CONTACT: {"marker": "X", **_EARLY, "color": RED},
    ENDINGS[StepEvent.JAM]: {"marker": "X", **_EARLY},
    ENDINGS[StepEvent.FLIP]: {"marker": "^", **_EARLY},
    ENDINGS[StepEvent.OUT_OF_BOUNDS]: {"marker": "D", **_EARLY},
    ENDINGS[StepEvent.STUCK]: {"marker": "P", **_EARLY},
    ENDINGS[StepEvent.INVALID_ACTION]: {"marker": "v", **_EARLY},
}
_COMPONENTS = (BLUE, ORANGE, PURPLE, RED, SKY)  # colors of the reward components other than the green goal component
_GOAL_LINE: dict[str, Any] = {"color": GREEN, "linewidth": 1.2, "linestyle": "--"}
_ENDING_LINE: dict[str, Any] = {"color": "black", "linewidth": 1.2, "linestyle": ":"}
_COLLISION: dict[str, Any] = {"color": RED, "alpha": 0.2, "linewidth": 0}


def draw_reward_components(rollout: TensorDictBase, path: Path, *, dt: float = CONTROL_DT) -> None:
    """Draws the reward components of a rover over time, each on its own scale, and the cumulative reward.

    Components that are always 0 are left out. Lines mark goals and endings, shading marks collisions. ``rollout`` is
    that of one rover, ``[T]`` or ``[1, T]``, as ``make_env(...).rollout(T)`` returns it. A step takes ``dt``, s.
    """
    if rollout.numel() != rollout.batch_size[-1]:
        raise ValueError(f"draw the rollout of one rover, not of batch size {tuple(rollout.batch_size)}")
    steps = rollout.reshape(-1)["next"]
    if "reward_components" not in steps:
        raise ValueError("the rollout has no reward components; make_env() returns an environment with them")
    components = {name: value.squeeze(-1).numpy() for name, value in steps["reward_components"].items()}
    components = {name: values for name, values in components.items() if values.any()}
    total = steps["outcome", "total_steps"].squeeze(-1).numpy()
    # The rollout may begin in the middle of an episode: time counts from the start of its first episode.
    seconds = (total - total[0] + steps["outcome", "steps"][0].item()) * dt

    figure = Figure(figsize=(9, 2.6 + 0.9 * len(components)), layout="constrained")
    panels = figure.subplots(len(components) + 1, 1, sharex=True, height_ratios=[1] * len(components) + [2])
    colors = (color for _ in components for color in _COMPONENTS)
    for ax, (name, values) in zip(panels, components.items(), strict=False):
        color = GREEN if name == "goal" else next(colors)
        ax.fill_between(seconds, values, step="pre", color=color, linewidth=1)
        ax.set_ylabel(f"{name.replace('_', ' ')}\nsum {values.sum():+,.2f}", rotation=0, ha="right", va="center")
    reward = np.sum(list(components.values()), 0) if components else np.zeros(len(seconds))
    panels[-1].plot(seconds, np.cumsum(reward), color="black", linewidth=1.8)
    panels[-1].set(xlabel="time (s)", xlim=(seconds[0] - dt, seconds[-1]))
    panels[-1].set_ylabel(f"cumulative reward\nfinal {reward.sum():+,.2f}", rotation=0, ha="right", va="center")
    figure.align_ylabels(panels)
    figure.legend(handles=_mark_events(panels, seconds, steps), loc="outside upper center", ncols=3, frameon=False)
    save_figure(figure, path)


def _mark_events(panels: Sequence[Axes], seconds: np.ndarray, steps: TensorDictBase) -> list[Line2D | Patch]:
    outcome = steps["outcome"]
    goals, endings = seconds[outcome["goal_reached"].squeeze(-1)], np.flatnonzero(steps["done"].squeeze(-1))
    collision = outcome["collision"].squeeze(-1).numpy()
    for ax in panels:
        style_axes(ax)
        ax.axhline(0, color=GREY, linewidth=0.8)
        ax.fill_between(seconds, 0, 1, collision, step="pre", transform=ax.get_xaxis_transform(), **_COLLISION)
        for time in goals:
            ax.axvline(time, **_GOAL_LINE)
        for time in seconds[endings]:
            ax.axvline(time, **_ENDING_LINE)
    kinds = [ENDINGS.get(StepEvent(phase), TIME_LIMIT) for phase in outcome["phase"].squeeze(-1)[endings].tolist()]
    handles: list[Line2D | Patch] = [Line2D([], [], label=f"goal ({len(goals)})", **_GOAL_LINE)] if len(goals) else []
    if collision.any():
        handles.append(Patch(label="collision", **_COLLISION))
    if kinds:
        handles.append(Line2D([], [], label="end: " + ", ".join(dict.fromkeys(kinds)), **_ENDING_LINE))
    return handles
