"""Plot of the results of ``python -m benchmarks gpu``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from rover_rl.algos.evaluation.plots import BLUE, GREEN, GREY, ORANGE
from rover_rl.files import written_whole

_STYLES = {"physics": GREEN, "lidar": ORANGE, "environment": BLUE}
_SHARES = {"device: simulation": GREEN, "device: task and policy": BLUE, "device: update": ORANGE, "device: idle": GREY}
_BELOW: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.15), "ncols": 4}
"""Place of a legend below its panel."""


def draw(results: dict[str, Any], path: Path) -> None:
    """Draws steps per second over rovers for each number of beams, and what the device does in training."""
    speed = [row for row in _rows(results, "speed") if "error" not in row]
    if not speed:
        return
    world, all_beams = speed[0]["world"], sorted({row["beams"] for row in speed})
    training = [row for row in _rows(results, "training") if "device: idle" in row]
    panels = len(all_beams) + bool(training)
    figure = Figure(figsize=(5.2 * panels, 4.2), layout="constrained")
    axes = figure.subplots(1, panels, squeeze=False)[0]
    for ax, beams in zip(axes, all_beams, strict=False):
        _speed(ax, [row for row in speed if row["beams"] == beams and row["world"] == world], beams)
    if training:
        _training(axes[-1], training)
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
    machine = results["machine"]
    figure.suptitle(f"{world}, {machine.get('gpu') or machine.get('processor')}", x=0.01, ha="left", fontweight="bold")
    with written_whole(path) as temporary:
        figure.savefig(temporary, dpi=150)


def _rows(results: dict[str, Any], section: str) -> list[dict[str, Any]]:
    """Rows of a section; none if it failed."""
    return results[section] if isinstance(results[section], list) else []


def _speed(ax: Axes, rows: list[dict[str, Any]], beams: int) -> None:
    rovers = [row["rovers"] for row in rows]
    for name, color in _STYLES.items():
        ax.plot(rovers, [row[name] for row in rows], "o-", color=color, label=name)
    ax.set(xscale="log", yscale="log", xlabel="rovers", title=f"steps/s, {beams} beams")
    ax.set_xticks(rovers, [f"{count:,}" for count in rovers])
    ax.xaxis.set_minor_locator(NullLocator())
    ax.legend(frameon=False, **_BELOW)


def _training(ax: Axes, rows: list[dict[str, Any]]) -> None:
    names = [f"{row['rovers']:,}{', map' if row['map'] else ''}" for row in rows]
    left = [0.0] * len(rows)
    for share, color in _SHARES.items():
        values = [row[share] for row in rows]
        ax.barh(names, values, left=left, color=color, label=share.removeprefix("device: "))
        left = [before + value for before, value in zip(left, values, strict=True)]
    ax.invert_yaxis()
    ax.set(title="PPO: what the device does", xlim=(0, 1), xlabel="share of the wall-clock time")
    ax.legend(frameon=False, **_BELOW)
