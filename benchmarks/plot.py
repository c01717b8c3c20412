"""Plot of the results of ``python -m benchmarks``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rover_rl.algos.evaluation.plots import BLUE, GREEN, GREY, ORANGE
from rover_rl.files import written_whole


def draw(results: dict[str, Any], path: Path) -> None:
    """Draws a panel for each result that has one: speed of rollouts, comparison with peers, and training."""
    panels = {name: panel for name, panel in PANELS.items() if name in results}
    if not panels:
        return
    figure = Figure(figsize=(5.2 * len(panels), 4.2), layout="constrained")
    for ax, (name, panel) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        panel(ax, results[name])
        ax.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"{results['world']}, {results['machine']['cores']} cores", x=0.01, ha="left", fontweight="bold")
    with written_whole(path) as temporary:
        figure.savefig(temporary, dpi=150)


def _speed(ax: Axes, rows: list[dict[str, Any]]) -> None:
    for beams, color in zip(sorted({row["beams"] for row in rows}), (GREEN, BLUE, ORANGE, GREY), strict=False):
        some = [row for row in rows if row["beams"] == beams]
        rovers = [row["num_envs"] for row in some]
        ax.plot(rovers, [row["steps_per_s"] for row in some], "o-", color=color, label=f"{beams} beams")
        shared = [row for row in some if row["all_workers"]]
        ax.plot(
            [row["num_envs"] for row in shared], [row["all_workers"] for row in shared], "o--", color=color, alpha=0.6
        )
    ax.set(xscale="log", ylim=(0, None), xlabel="rovers", title="steps/s; dashed: all workers")
    counts = sorted({row["num_envs"] for row in rows})
    ax.set_xticks(counts, [f"{count:,}" for count in counts])
    ax.minorticks_off()
    ax.legend(frameon=False)


def _peers(ax: Axes, rows: list[dict[str, Any]]) -> None:
    rows = [row for row in rows if "median" in row]
    names = [f"{row['peer']},\n{row['processes']} processes" for row in rows]
    ax.barh(names, [row["median"] for row in rows], color=BLUE)
    ax.axvline(1, color=GREY, linewidth=1)
    ax.invert_yaxis()
    ax.set(title="speedup of rover_rl over", xlim=(0, None))


def _training(ax: Axes, rows: list[dict[str, Any]]) -> None:
    names = [f"{row['algo'].upper()}, {row['name']}" for row in rows]
    colors = [BLUE if row["name"] == "rover_rl" else ORANGE for row in rows]
    ax.barh(names, [row["steps_per_s"] for row in rows], color=colors)
    ax.invert_yaxis()
    ax.set(title="steps/s in training", xlim=(0, None))


PANELS = {"rollouts": _speed, "peers": _peers, "training": _training}
"""Functions that draw a panel, by the name of the benchmark."""
