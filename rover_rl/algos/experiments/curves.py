"""Learning curves of one run or of several experiments. They need no display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle, product
from pathlib import Path
from textwrap import fill
from typing import Any, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import EngFormatter, PercentFormatter
from scipy.stats import trim_mean

from rover_rl.algos.evaluation.metrics import proportion
from rover_rl.algos.evaluation.plots import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, save_figure, style_axes
from rover_rl.algos.evaluation.results import Evaluation
from rover_rl.algos.experiments.runs import WINDOW, Against, Experiment, Measure, Run, group
from rover_rl.algos.experiments.statistics import interval

Panels: TypeAlias = Sequence[tuple[Measure, Against]]  # what each column of panels shows, and against what
OF_A_RUN: Panels = (("success", "steps"), ("goals", "steps"))  # panels of a single run
COMPARED: Panels = (("success", "steps"), ("success", "minutes"))
"""Panels of a comparison: what was learned from the same data, and in the same time."""

_AXES = {"steps": "environment steps of all rovers", "minutes": "training time (min)"}
_POINTS = 240  # number of points of a curve
_NARROW = 1 / 100  # width of the averaging window of the faint line, as a fraction of the run
_PALETTES = {"ppo": (BLUE, GREEN, SKY, PURPLE, ORANGE, RED), "sac": (RED, ORANGE, PURPLE, SKY, GREEN, BLUE)}
"""Colors of each algorithm's curves, one for each of its settings in turn."""
_LINES = ("-", "--", ":", "-.")  # styles of the lines, one for each turn through the colors
_LABEL = 96  # largest number of characters in a line of the legend
_LONG_LABEL = 48  # largest number of characters of a label in a legend with two columns


def draw_learning_curve(runs: Sequence[str | Path], path: Path, panels: Panels = OF_A_RUN) -> None:
    """Draws success rate and goals against training steps or training time, with a row of panels for each world.

    Each point is a ratio of sums over a window of a twelfth of the run, so that it does not depend on the number of
    rows in ``progress.csv``. Runs that differ in their seed only are drawn as one curve: their interquartile mean and
    its 95 % interval, up to the end of the shortest run. A single run also has a faint line with a narrower window.

    Raises a ``FileNotFoundError`` if a folder holds no run, and a ``ValueError`` for no runs, or one without rows.
    """
    if not runs:
        raise ValueError("name at least one run to draw")
    curves = _curves(group([Run.read(folder) for folder in runs]))
    worlds = list(dict.fromkeys(curve.experiment.world for curve in curves))
    figure = Figure(figsize=(10, 0.6 + 3.7 * len(worlds)), layout="constrained")
    for world, row in zip(worlds, figure.subplots(len(worlds), len(panels), squeeze=False), strict=True):
        here = [curve for curve in curves if curve.experiment.world == world]
        for ax, (measure, against) in zip(row, panels, strict=True):
            for curve in here:
                curve.draw(ax, measure, against)
            _finish(ax, measure, against, max(curve.experiment.end(against) for curve in here))
        row[0].set_title(world, loc="left", fontweight="bold")
    handles = _legend(curves)
    # Two long labels do not fit side by side.
    columns = 1 if max(len(str(handle.get_label())) for handle in handles) > _LONG_LABEL else 2
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False)
    save_figure(figure, path)


def draw_test_curve(folder: str | Path, tests: Mapping[int, Evaluation], path: Path) -> None:
    """Draws the share of goals that a run's policies reach in the same test, with 95 % intervals, against time.

    ``tests`` are evaluations of the run's policies, by the number of steps that each was trained for.
    """
    run = Run.read(folder)
    seconds = 60 * np.interp([*tests], [0, *run.x["steps"]], [0, *run.x["minutes"]])
    rates = [proportion(int(test.reached.sum()), len(test.reached)) for test in tests.values()]
    values = np.array([(rate.value, rate.low, rate.high) for rate in rates])
    figure = Figure(figsize=(6.4, 4), layout="constrained")
    ax = figure.subplots()
    ax.fill_between(seconds, values[:, 1], values[:, 2], color=BLUE, alpha=0.15, linewidth=0)
    ax.plot(seconds, values[:, 0], color=BLUE, linewidth=2.2, marker="o")
    for x, value in zip(seconds, values[:, 0], strict=True):
        ax.annotate(f"{value:.0%}", (x, value), (0, 8), textcoords="offset points", ha="center")
    ax.set(xlabel="training time (s)", ylabel="goals reached in the test", ylim=(0, 1.1), yticks=np.linspace(0, 1, 6))
    ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    what = run.config.run.task_name or run.folder.name
    ax.set_title(f"{run.config.algo.upper()} learns {what}", loc="left", fontweight="bold")
    style_axes(ax)
    save_figure(figure, path)


@dataclass(frozen=True)
class _Curve:
    experiment: Experiment
    style: dict[str, Any]
    named: bool

    @property
    def label(self) -> str:
        experiment, runs = self.experiment, self.experiment.runs
        steps, minutes = (np.mean([run.x[key][-1] for run in runs]) for key in ("steps", "minutes"))
        of = "" if len(runs) == 1 else f"{len(runs)} runs of "
        named = self.named and experiment.name != experiment.settings
        name = f"{experiment.name} ({experiment.title})" if named else experiment.title
        return fill(f"{name}: {of}{steps:,.0f} steps in {minutes:.1f} min", _LABEL)

    def draw(self, ax: Axes, measure: Measure, against: Against) -> None:
        runs, end = self.experiment.runs, self.experiment.end(against)
        at = np.linspace(0, end, _POINTS)
        curves = np.array([run.curve(measure, against, at, end * WINDOW) for run in runs])
        if len(runs) == 1:
            fine = runs[0].curve(measure, against, at, end * _NARROW)
            ax.plot(at, fine, **self.style, alpha=0.25, linewidth=1)
        else:
            low, high = interval([curves])
            ax.fill_between(at, low, high, color=self.style["color"], alpha=0.2, linewidth=0)
        ax.plot(at, trim_mean(curves, 0.25), **self.style, linewidth=2.2)


def _curves(experiments: Sequence[Experiment]) -> list[_Curve]:
    curves, styles = [], {algo: cycle(product(_LINES, colors)) for algo, colors in _PALETTES.items()}
    for experiment in sorted(experiments, key=lambda one: (one.world, one.settings)):
        line, color = next(styles[experiment.runs[0].config.algo])
        curves.append(_Curve(experiment, {"color": color, "linestyle": line}, len(experiments) > 1))
    return curves


def _finish(ax: Axes, measure: Measure, against: Against, end: float) -> None:
    if measure == "success":
        ax.set(ylabel="success rate (attempts at a goal)", ylim=(0, 1.02))
        ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    else:
        ax.set(ylabel="goals per 2,000 steps", ylim=(0, max(1, ax.get_ylim()[1])))
    ax.set(xlabel=_AXES[against], xlim=(0, end))
    if against == "steps":
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))
    style_axes(ax)


def _legend(curves: Sequence[_Curve]) -> list[Line2D | Patch]:
    handles: list[Line2D | Patch] = [Line2D([], [], linewidth=2.2, label=one.label, **one.style) for one in curves]
    counts = {len(one.experiment.runs) for one in curves}
    if counts != {1}:
        label = "lines: interquartile mean of the runs; areas: its 95 % interval"
        handles.append(Patch(color=GREY, alpha=0.3, linewidth=0, label=label))
    if 1 in counts:
        label = f"averaged over {_NARROW:.0%} of the run instead of {WINDOW:.0%}"
        handles.append(Line2D([], [], color=GREY, alpha=0.4, linewidth=1, label=label))
    return handles
