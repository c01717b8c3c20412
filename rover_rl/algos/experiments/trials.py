"""Trials of a sweep: table, CSV file and figure."""

from __future__ import annotations

import math
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from rover_rl.algos.evaluation.plots import BLUE, ORANGE, style_axes
from rover_rl.algos.evaluation.report import write_rows
from rover_rl.algos.experiments.space import Choice, Interval
from rover_rl.algos.experiments.sweep import Sweep, text_of
from rover_rl.files import written_whole

_COLUMNS = 4
"""Largest number of panels in a row."""


def print_trials(sweep: Sweep, console: Console | None = None) -> None:
    """Prints a table of the trials with a result, the best first."""
    console = console or Console()
    table = Table(title=escape(str(sweep.folder)), box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("trial", justify="right", no_wrap=True)
    for setting in sweep.space:
        table.add_column(escape(setting.name), justify="right", overflow="fold")
    for heading in ("success\n%", "time\ns", "training\nmin"):
        table.add_column(heading, justify="right", no_wrap=True)
    for trial in sweep.finished:
        result = trial.user_attrs
        success = f"{100 * (trial.value or 0):.0f} [{100 * result['low']:.0f}–{100 * result['high']:.0f}]"
        time = "-" if math.isnan(result["seconds"]) else f"{result['seconds']:.1f}"
        values = [escape(text_of(value)) for value in sweep.settings(trial).values()]
        table.add_row(f"trial-{trial.number}", *values, success, time, f"{result['minutes']:.1f}")
    console.print(table)
    console.print(
        "success: in brackets, 95 % confidence interval, within which trials are not told apart; "
        "time: mean time to a goal.",
        style="dim",
        highlight=False,
    )


def write_trials(sweep: Sweep, path: Path) -> None:
    """Writes the trials with a result as CSV, the best first."""
    write_rows(
        path,
        [
            {
                "trial": sweep.trial_folder(trial).name,
                **sweep.settings(trial),
                "success": trial.value,
                **trial.user_attrs,
            }
            for trial in sweep.finished
        ],
    )


def draw_trials(sweep: Sweep, path: Path) -> None:
    """Draws the success rate of each trial, with its 95 % interval, against each setting that varies."""
    trials, columns = sweep.finished, min(_COLUMNS, len(sweep.space))
    rows = math.ceil(len(sweep.space) / columns)
    figure = Figure(figsize=(1.2 + 3.4 * columns, 3.4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True).flat
    for ax, setting in zip(panels, sweep.space, strict=False):
        order = [*setting.values] if isinstance(setting, Choice) else []
        for place, trial in reversed([*enumerate(trials)]):
            drawn, rate = trial.params[setting.name], trial.value or 0.0
            ends = [[rate - trial.user_attrs["low"]], [trial.user_attrs["high"] - rate]]
            # Trials with the same choice stand side by side.
            side = 0.5 * (trial.number + 0.5) / len(trials) - 0.25
            x = order.index(drawn) + side if order else setting.value(drawn)
            color = BLUE if place else ORANGE
            label = None if place else f"best trial: {trial.number}"
            ax.errorbar(x, rate, ends, fmt="o", color=color, elinewidth=0.8, clip_on=False, label=label)
        if order:
            ax.set_xticks(range(len(order)), order)
            ax.set_xlim(-0.5, len(order) - 0.5)
        elif isinstance(setting, Interval):
            # Trials at the ends are not cut.
            ax.set(xscale="log" if setting.log else "linear", xlim=(setting.low, setting.high))
            ax.margins(x=0.05)
        ax.set(xlabel=setting.name, ylim=(0, 1.02))
        ax.yaxis.set_major_formatter(PercentFormatter(1.0))
        style_axes(ax)
    figure.axes[0].set_ylabel("success rate")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", frameon=False)
    for ax in figure.axes[len(sweep.space) :]:
        ax.remove()
    with written_whole(path) as temporary:
        figure.savefig(temporary, dpi=150)
