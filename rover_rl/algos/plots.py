"""Pictures of training and of driving, with Matplotlib's object interface: they need no display."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, PercentFormatter
from torch import Tensor

from rover_rl.algos.evaluate import Evaluation
from rover_rl.algos.progress import read_progress
from rover_rl.algos.runs import written_whole
from rover_rl.sims.worlds.draw import draw_map
from rover_rl.sims.worlds.world import Area

REACHED, MISSED, CURVE, BASELINE = "#1d6fd8", "#d62828", "#1d6fd8", "#6b7280"


def draw_learning_curve(progress: Path, path: Path, baseline: Evaluation | None = None) -> None:
    """Draws success rate and goals an episode against the steps trained for.

    Args:
        progress: the run's ``progress.csv``.
        path: of the picture; the suffix decides on the format.
        baseline: a policy whose level is drawn as a dashed line.

    Raises:
        FileNotFoundError: without a ``progress.csv``.
        ValueError: if nothing is in it yet.
    """
    columns = {key: np.array(values) for key, values in read_progress(progress).items()}
    if not columns:
        raise ValueError(f"{progress} holds no rows yet")
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    steps, ones = columns["steps"], np.ones_like(columns["steps"])
    _draw_curve(left, steps, columns["episodes_reached"], columns["episodes"])
    _draw_curve(right, steps, columns["goals_per_2000_steps"], ones)
    if baseline is not None:
        style: dict[str, Any] = {
            "color": BASELINE,
            "linestyle": "--",
            "linewidth": 1.8,
            "label": f"{baseline.name} policy",
        }
        # Over the axis, and not cut off by it, because a level of 0 is on it.
        style |= {"clip_on": False, "zorder": 3}
        left.axhline(baseline.success_rate, **style)
        right.axhline(baseline.goals_per_2000_steps, **style)
    left.set(ylabel="success: episodes that reach a goal", ylim=(0, 1.02))
    left.yaxis.set_major_formatter(PercentFormatter(1.0))
    right.set(ylabel="goals per episode of 2,000 steps")
    right.set_ylim(bottom=0)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle(f"{steps[-1]:,.0f} steps of training in {columns['minutes'][-1]:.1f} minutes")
    with written_whole(path) as temporary:
        figure.savefig(temporary, dpi=150)


def _draw_curve(ax: Axes, steps: np.ndarray, counts: np.ndarray, of: np.ndarray) -> None:
    """One measure, ``counts / of``: each batch faintly, and the ratio over a running window."""
    with np.errstate(invalid="ignore"):
        ax.plot(steps, counts / of, color=CURVE, alpha=0.25, linewidth=1, label="a batch (exploring)")
        ax.plot(steps, window_sum(counts) / window_sum(of), color=CURVE, linewidth=2.2, label="running mean")
    ax.set(xlabel="steps (20 Hz, all rovers together)", xlim=(0, steps[-1]))
    ax.xaxis.set_major_formatter(EngFormatter(sep=""))
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(axis="y", color="#e5e7eb")


def window_sum(values: np.ndarray) -> np.ndarray:
    """Sum over a centred window of about a twelfth of ``values [n]``; shorter towards the ends."""
    half = max(1, len(values) // 24)
    total = np.concatenate(([0.0], np.cumsum(values)))
    index = np.arange(len(values))
    return total[np.minimum(index + half + 1, len(values))] - total[np.maximum(index - half, 0)]


def draw_paths(evaluations: Sequence[Evaluation], path: Path, most: int = 32) -> None:
    """Draws where policies drove, from above, a panel each.

    Args:
        evaluations: of policies on the same episodes.
        path: of the picture; the suffix decides on the format.
        most: draw no more episodes than these, the first ones.
    """
    points = torch.cat([points for evaluation in evaluations for points in evaluation.paths[:most]])
    area = _square_around(torch.cat((points, evaluations[0].episodes.goal[:most])))
    figure = Figure(figsize=(6.2 * len(evaluations), 6.9), layout="constrained")
    panels = figure.subplots(1, len(evaluations), squeeze=False)[0]
    for ax, evaluation in zip(panels, evaluations, strict=True):
        _draw_panel(ax, evaluation, area, most)
    figure.legend(handles=_LEGEND, loc="outside lower center", ncols=len(_LEGEND), frameon=False)
    with written_whole(path) as temporary:
        figure.savefig(temporary, dpi=150)


def _square_around(points: Tensor, margin: float = 1.0) -> Area:
    """The square that holds ``points [n, 2]`` with a margin, m."""
    low, high = points.amin(0), points.amax(0)
    centre, half = (low + high) / 2, (high - low).max() / 2 + margin
    (left, bottom), (right, top) = (centre - half).tolist(), (centre + half).tolist()
    return (left, right), (bottom, top)


def _draw_panel(ax: Axes, evaluation: Evaluation, area: Area, most: int) -> None:
    episodes = evaluation.episodes
    draw_map(ax, episodes.world, area)
    reached = evaluation.reached[:most].numpy()
    paths = [points.numpy() for points in evaluation.paths[:most]]
    ends = np.array([points[-1] for points in paths])
    colors = [REACHED if success else MISSED for success in reached]
    ax.add_collection(LineCollection(paths, colors=colors, linewidths=1.8, alpha=0.75, zorder=4))
    ax.scatter(*episodes.goal[:most].T, zorder=5, **_GOAL)
    ax.scatter(*episodes.start[:most, :2].T, zorder=6, **_START)
    ax.scatter(*ends[reached].T, zorder=7, **_REACHED)
    ax.scatter(*ends[~reached].T, zorder=7, **_MISSED)
    shown, total = len(paths), len(evaluation.paths)
    drawn = "" if shown == total else f" ({shown} of {total} drawn)"
    share, limit = evaluation.success_rate, evaluation.seconds
    ax.set_title(f"{evaluation.name}: {share:.0%} reach the goal within {limit:g} s{drawn}")


_GOAL: dict[str, Any] = {"s": 90, "marker": "*", "color": "#f59e0b", "edgecolor": "black", "linewidth": 0.6}
_START: dict[str, Any] = {"s": 26, "color": "white", "edgecolor": "black", "linewidth": 1.0}
_REACHED: dict[str, Any] = {"s": 22, "color": REACHED, "edgecolor": "white", "linewidth": 0.5}
_MISSED: dict[str, Any] = {"s": 36, "marker": "x", "color": MISSED, "linewidth": 1.8}
_LEGEND = [
    Line2D([], [], linestyle="", marker="o", color="white", markeredgecolor="black", markersize=5, label="start"),
    Line2D([], [], linestyle="", marker="*", color="#f59e0b", markeredgecolor="black", markersize=9, label="goal"),
    Line2D([], [], color=REACHED, marker="o", markersize=4, label="reached"),
    Line2D([], [], color=MISSED, marker="x", markersize=6, label="not reached"),
]
