"""Pictures of training and of driving, with Matplotlib's object interface: they need no display.

Colours are those of Okabe and Ito, and plasma: they differ for colour-blind readers, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import EngFormatter, PercentFormatter
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.algos.config import SECONDS_PER_STEP, TrainingConfig, experiments, run_config
from rover_rl.algos.evaluation.evaluate import ENDINGS, Evaluation
from rover_rl.algos.evaluation.metrics import TIME_LIMIT, Trajectory
from rover_rl.algos.train.progress import EPISODE_STEPS, read_progress
from rover_rl.envs import StepEvent
from rover_rl.files import written_whole
from rover_rl.sims.worlds import World
from rover_rl.sims.worlds.draw import draw_map
from rover_rl.sims.worlds.world import Area

BLUE, ORANGE, GREEN, PURPLE, RED, SKY = "#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9"
GREY, GRID = "#6b7280", "#e5e7eb"

Against: TypeAlias = Literal["steps", "minutes"]
_AXES = {"steps": "steps (20 Hz, all rovers together)", "minutes": "minutes of training"}
_POINTS = 240
"""Of a learning curve."""
_WINDOW = 1 / 12
"""Share of a run that a point of its curve looks at."""
_NARROW = 1 / 100
"""The same for the faint line behind it."""
_LINES = {"ppo": (BLUE, SKY, GREEN), "sac": (RED, ORANGE, PURPLE)}
"""Colours by algorithm, one for each of its settings in turn."""


def draw_learning_curve(
    runs: Sequence[Path], path: Path, baseline: Evaluation | None = None, *, against: Against = "steps"
) -> None:
    """Draws success and goals against the steps trained for, or against the time: a row of panels for each world.

    Every point of a line is a ratio of sums over a window of a twelfth of the run, however many decisions its rows
    have. Runs that differ in their seed only are drawn as one: their mean, and the least and the most of them, up to
    where the shortest of them ends. A run by itself has narrower windows behind it.

    Args:
        runs: their folders, each with ``config.yaml`` and ``progress.csv``.
        path: of the picture; the suffix decides on the format.
        baseline: a policy whose level in its world is drawn as a dashed line.
        against: what the x axis shows.

    Raises:
        FileNotFoundError: if a folder is not that of a run.
        ValueError: without runs, or if one has no rows yet.
    """
    if not runs:
        raise ValueError("name at least one run to draw")
    groups = _grouped([_Run.read(Path(folder)) for folder in runs], against)
    worlds = list(dict.fromkeys(group.world for group in groups))
    figure = Figure(figsize=(10, 0.6 + 3.7 * len(worlds)), layout="constrained")
    for world, panels in zip(worlds, figure.subplots(len(worlds), 2, squeeze=False), strict=True):
        here = [group for group in groups if group.world == world]
        for ax, measure in zip(panels, ("success", "goals"), strict=True):
            for group in here:
                group.draw(ax, measure)
        if baseline is not None and baseline.episodes.name == world:
            _draw_baseline(panels, baseline)
        _finish_curves(panels, max(group.end for group in here), against)
        panels[0].set_title(world, loc="left", fontweight="bold")
    handles = _curve_legend(groups, baseline)
    # Two long ones do not fit side by side.
    columns = 1 if max(len(str(handle.get_label())) for handle in handles) > _LONG_LABEL else 2
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False)
    with written_whole(path) as temporary:
        figure.savefig(temporary, dpi=150)


@dataclass(frozen=True)
class _Run:
    """What ``progress.csv`` tells of a run.

    Attributes:
        config: its settings.
        x: steps and minutes after each row, ``[rows]`` each.
        measures: what is counted in each row and what it is a share of, ``[rows]`` each, by the measure's name.
    """

    config: TrainingConfig
    x: dict[str, np.ndarray]
    measures: dict[str, tuple[np.ndarray, np.ndarray]]

    @classmethod
    def read(cls, folder: Path) -> _Run:
        config = run_config(folder)
        columns = {key: np.array(values) for key, values in read_progress(folder / "progress.csv").items()}
        if not columns:
            raise ValueError(f"{folder / 'progress.csv'} holds no rows yet")
        full_episodes = np.diff(columns["steps"], prepend=0) / EPISODE_STEPS
        success = columns["episodes_reached"], columns["episodes"]
        goals = columns["goals_per_2000_steps"] * full_episodes, full_episodes
        x = {"steps": columns["steps"], "minutes": columns["minutes"]}
        return cls(config, x, {"success": success, "goals": goals})

    def curve(self, measure: str, against: Against, at: np.ndarray, width: float) -> np.ndarray:
        """The measure in windows of ``width`` around ``at [points]``, shorter at the ends; nan without a count."""
        edges = np.concatenate(([0.0], self.x[against]))

        def within(values: np.ndarray) -> np.ndarray:
            total = np.concatenate(([0.0], np.cumsum(values)))
            return np.interp(at + width / 2, edges, total) - np.interp(at - width / 2, edges, total)

        counts, of = self.measures[measure]
        with np.errstate(invalid="ignore"):
            return within(counts) / within(of)


@dataclass(frozen=True)
class _Group:
    """Runs that differ in their seed at most, drawn as one line over ``against`` up to ``end``."""

    name: str
    color: str
    runs: list[_Run]
    against: Against

    @property
    def world(self) -> str:
        return ", ".join(self.runs[0].config.worlds)

    @property
    def end(self) -> float:
        """Where the shortest run ends."""
        return min(run.x[self.against][-1] for run in self.runs)

    @property
    def label(self) -> str:
        steps, minutes = (np.mean([run.x[key][-1] for run in self.runs]) for key in ("steps", "minutes"))
        runs = "" if len(self.runs) == 1 else f"mean of {len(self.runs)} runs of "
        return f"{self.name}: {runs}{steps:,.0f} steps in {minutes:.1f} min"

    def draw(self, ax: Axes, measure: str) -> None:
        at, width = np.linspace(0, self.end, _POINTS), self.end * _WINDOW
        if len(self.runs) == 1:
            fine = self.runs[0].curve(measure, self.against, at, self.end * _NARROW)
            ax.plot(at, fine, color=self.color, alpha=0.25, linewidth=1)
        curves = [run.curve(measure, self.against, at, width) for run in self.runs]
        ax.fill_between(at, np.min(curves, 0), np.max(curves, 0), color=self.color, alpha=0.2, linewidth=0)
        ax.plot(at, np.mean(curves, 0), color=self.color, linewidth=2.2)


def _grouped(runs: Sequence[_Run], against: Against) -> list[_Group]:
    together: dict[str, list[_Run]] = {}
    for name, run in zip(experiments([run.config for run in runs]), runs, strict=True):
        together.setdefault(name, []).append(run)
    colors = {algo: cycle(palette) for algo, palette in _LINES.items()}
    return [
        _Group(name, next(colors[together[name][0].config.algo]), together[name], against) for name in sorted(together)
    ]


def _finish_curves(panels: Sequence[Axes], end: float, against: Against) -> None:
    success, goals = panels
    success.set(ylabel="success: episodes with a goal", ylim=(0, 1.02))
    success.yaxis.set_major_formatter(PercentFormatter(1.0))
    goals.set(ylabel="goals per 2,000 steps", ylim=(0, max(1, goals.get_ylim()[1])))
    for ax in panels:
        ax.set(xlabel=_AXES[against], xlim=(0, end))
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))
        _tidy(ax)


def _tidy(ax: Axes) -> None:
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(axis="y", color=GRID)
    ax.set_axisbelow(True)


_BASELINE: dict[str, Any] = {"color": GREY, "linestyle": "--", "linewidth": 1.8}


def _draw_baseline(panels: Sequence[Axes], baseline: Evaluation) -> None:
    for ax, level in zip(panels, (baseline.success_rate, baseline.goals_per_2000_steps), strict=True):
        # Over the axis, and not cut off by it, because a level of 0 is on it.
        ax.axhline(level, clip_on=False, zorder=3, **_BASELINE)


_LONG_LABEL = 48
"""Letters."""


def _curve_legend(groups: Sequence[_Group], baseline: Evaluation | None) -> list[Line2D | Patch]:
    handles: list[Line2D | Patch] = [Line2D([], [], color=g.color, linewidth=2.2, label=g.label) for g in groups]
    if any(len(group.runs) > 1 for group in groups):
        handles.append(Patch(color=GREY, alpha=0.3, linewidth=0, label="least to most of the runs"))
    if any(len(group.runs) == 1 for group in groups):
        label = f"over {_NARROW:.0%} of the run instead of {_WINDOW:.0%}"
        handles.append(Line2D([], [], color=GREY, alpha=0.4, linewidth=1, label=label))
    if baseline is not None and any(group.world == baseline.episodes.name for group in groups):
        handles.append(Line2D([], [], label=f"{baseline.name} policy", **_BASELINE))
    return handles


_ABREAST = 3
"""Panels beside one another at most."""
_STRIDE = 4
"""Steps that a piece of a path is long: its speed is the mean over them."""
_SPEED = ScalarMappable(Normalize(0, 1), ListedColormap(colormaps["plasma_r"](np.linspace(0.12, 1, 256))))
"""Colours of speeds in m/s; slow is bright. The brightest yellow is left out, as it is hard to see on pale ground."""


def draw_paths(evaluations: Sequence[Evaluation], path: Path, most: int = 32) -> None:
    """Draws where policies drove and how fast, from above, a panel each.

    Args:
        evaluations: of policies on the same episodes.
        path: of the picture; the suffix decides on the format.
        most: draw no more episodes than these, the first ones.
    """
    episodes = evaluations[0].episodes
    points = [trajectory.path for evaluation in evaluations for trajectory in evaluation.trajectories[:most]]
    area = _square_around(torch.cat((*points, episodes.goal[:most])))
    rows = math.ceil(len(evaluations) / _ABREAST)
    columns = math.ceil(len(evaluations) / rows)
    figure = Figure(figsize=(5 * columns + 0.8, 5.3 * rows + 1.0), layout="compressed")
    first = f"\nthe first {most} of them are drawn" if len(episodes) > most else ""
    figure.suptitle(f"{evaluations[0].title}{first}")
    for number, evaluation in enumerate(evaluations, 1):
        ax = figure.add_subplot(rows, columns, number)
        _draw_driven(ax, evaluation, area, most)
        if number % columns != 1 and columns > 1:
            ax.set(ylabel="", yticklabels=[])
        if number + columns <= len(evaluations):
            ax.set(xlabel="", xticklabels=[])
    panels = list(figure.axes)
    figure.colorbar(_SPEED, ax=panels, label="speed over ground (m/s)", shrink=0.7, pad=0.01, extend="max")
    endings = {ending for evaluation in evaluations for ending in evaluation.endings[:most]}
    marks = {"start": _START, "goal": _GOAL, **{f"end: {kind}": _ENDS[kind] for kind in _ENDS if kind in endings}}
    handles = [panels[0].scatter([], [], label=label, **style) for label, style in marks.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=4 * columns, frameon=False)
    with written_whole(path) as temporary:
        figure.savefig(temporary, dpi=150)


def _square_around(points: Tensor, margin: float = 0.7) -> Area:
    """The square that holds ``points [n, 2]`` with a margin, m."""
    low, high = points.amin(0), points.amax(0)
    centre, half = (low + high) / 2, (high - low).max() / 2 + margin
    (left, bottom), (right, top) = (centre - half).tolist(), (centre + half).tolist()
    return (left, right), (bottom, top)


def _draw_driven(ax: Axes, evaluation: Evaluation, area: Area, most: int) -> None:
    episodes, driven = evaluation.episodes, evaluation.trajectories[:most]
    draw_pale_map(ax, episodes.world, area)
    pieces, speeds = zip(*(_pieces(trajectory) for trajectory in driven), strict=True)
    colors = _SPEED.to_rgba(np.concatenate(speeds))
    ax.add_collection(
        LineCollection(list(np.concatenate(pieces)), colors=colors, linewidths=1.8, capstyle="round", zorder=4)
    )
    ax.scatter(*episodes.goal[:most].T, zorder=5, **_GOAL)
    ax.scatter(*episodes.start[:most, :2].T, zorder=6, **_START)
    for ending, style in _ENDS.items():
        ends = [trajectory.path[-1].tolist() for trajectory in driven if trajectory.ending == ending]
        ax.scatter(*np.array(ends).reshape(-1, 2).T, zorder=7, **style)
    ax.set_title(f"{evaluation.name}: {evaluation.success_rate:.0%} reach the goal")


def draw_pale_map(ax: Axes, world: World, area: Area) -> None:
    """As :func:`draw_map`, with paler ground, on which paths stand out."""
    draw_map(ax, world, area)
    ax.add_patch(Rectangle((0, 0), 1, 1, transform=ax.transAxes, color="white", alpha=0.4, linewidth=0, zorder=1))


def _pieces(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Pieces of a path, ``[pieces, 2, 2]`` (m), and the mean speed on each, ``[pieces]`` (m/s)."""
    steps = np.unique(np.append(np.arange(0, len(trajectory), _STRIDE), len(trajectory)))
    points, driven = trajectory.path.numpy()[steps], np.cumsum(np.append(0.0, trajectory.speed.numpy()))
    return np.stack((points[:-1], points[1:]), 1), np.diff(driven[steps]) / np.diff(steps)


_START: dict[str, Any] = {"s": 24, "color": "white", "edgecolor": "black", "linewidth": 1.0}
_GOAL: dict[str, Any] = {"s": 90, "marker": "*", "color": GREEN, "edgecolor": "black", "linewidth": 0.6}
_EARLY: dict[str, Any] = {"s": 60, "color": "black", "edgecolor": "white", "linewidth": 0.8}
_ENDS: dict[str, dict[str, Any]] = {
    ENDINGS[StepEvent.GOAL]: {"s": 30, "color": GREEN, "edgecolor": "white", "linewidth": 0.8},
    TIME_LIMIT: {"s": 30, "marker": "s", "color": "white", "edgecolor": "black", "linewidth": 1.3},
    ENDINGS[StepEvent.JAM]: {"marker": "X", **_EARLY},
    ENDINGS[StepEvent.FLIP]: {"marker": "^", **_EARLY},
    ENDINGS[StepEvent.OUT_OF_BOUNDS]: {"marker": "D", **_EARLY},
    ENDINGS[StepEvent.STUCK]: {"marker": "P", **_EARLY},
    ENDINGS[StepEvent.INVALID_ACTION]: {"marker": "v", **_EARLY},
}
"""Marks of how episodes end."""


_COMPONENTS = (BLUE, ORANGE, PURPLE, RED, SKY)
"""Colours of reward components but the goal's, which is green."""
_GOAL_LINE: dict[str, Any] = {"color": GREEN, "linewidth": 1.2, "linestyle": "--"}
_ENDING_LINE: dict[str, Any] = {"color": "black", "linewidth": 1.2, "linestyle": ":"}
_COLLISION: dict[str, Any] = {"color": RED, "alpha": 0.2, "linewidth": 0}


def draw_reward_components(rollout: TensorDictBase, path: Path) -> None:
    """Draws what a rover was paid for over time: each component on a scale of its own, and the sum so far.

    Components that are 0 throughout are left out. Lines mark goals and endings, and shades mark collisions.

    Args:
        rollout: of one rover, ``[T]`` or ``[1, T]``, as ``make_env(...).rollout(T)`` gives it; it may hold several
            episodes.
        path: of the picture; the suffix decides on the format.

    Raises:
        ValueError: for several rovers, or without reward components.
    """
    if rollout.numel() != rollout.batch_size[-1]:
        raise ValueError(f"draw the rollout of one rover, not of batch size {tuple(rollout.batch_size)}")
    steps = rollout.reshape(-1)["next"]
    if "reward_components" not in steps:
        raise ValueError("the rollout has no reward components; make_env() gives an environment that has")
    components = {name: value.squeeze(-1).numpy() for name, value in steps["reward_components"].items()}
    components = {name: values for name, values in components.items() if values.any()}
    total = steps["outcome", "total_steps"].squeeze(-1).numpy()
    # Steps before the first of the rollout are those of its episode.
    seconds = (total - total[0] + steps["outcome", "steps"][0].item()) * SECONDS_PER_STEP

    figure = Figure(figsize=(9, 2.6 + 0.9 * len(components)), layout="constrained")
    panels = figure.subplots(len(components) + 1, 1, sharex=True, height_ratios=[1] * len(components) + [2])
    colors = (color for _ in components for color in _COMPONENTS)
    for ax, (name, values) in zip(panels, components.items(), strict=False):
        color = GREEN if name == "goal" else next(colors)
        ax.fill_between(seconds, values, step="pre", color=color, linewidth=1)
        ax.set_ylabel(f"{name.replace('_', ' ')}\nsum {values.sum():+,.2f}", rotation=0, ha="right", va="center")
    reward = np.sum(list(components.values()), 0) if components else np.zeros(len(seconds))
    panels[-1].plot(seconds, np.cumsum(reward), color="black", linewidth=1.8)
    panels[-1].set(xlabel="time (s)", xlim=(seconds[0] - SECONDS_PER_STEP, seconds[-1]))
    panels[-1].set_ylabel(f"total so far\nin the end {reward.sum():+,.2f}", rotation=0, ha="right", va="center")
    figure.align_ylabels(panels)
    figure.legend(handles=_mark_events(panels, seconds, steps), loc="outside upper center", ncols=3, frameon=False)
    with written_whole(path) as temporary:
        figure.savefig(temporary, dpi=150)


def _mark_events(panels: Sequence[Axes], seconds: np.ndarray, steps: TensorDictBase) -> list[Line2D | Patch]:
    """Marks in every panel what happened; returns what the legend says of it."""
    outcome = steps["outcome"]
    goals, endings = seconds[outcome["goal_reached"].squeeze(-1)], np.flatnonzero(steps["done"].squeeze(-1))
    collision = outcome["collision"].squeeze(-1).numpy()
    for ax in panels:
        _tidy(ax)
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
