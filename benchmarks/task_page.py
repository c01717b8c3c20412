"""Cards of entries in the tasks, and the page and the picture that they give: see :mod:`benchmarks.tasks`."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import trim_mean

from rover_rl.algos.evaluation.metrics import Estimate, proportion
from rover_rl.algos.evaluation.plots import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, style_axes
from rover_rl.algos.experiments.statistics import interquartile_mean, interval
from rover_rl.files import written_whole

Card: TypeAlias = dict[str, Any]
ROOT = Path(__file__).parents[1]
CARDS, PAGE, PICTURE = ROOT / "benchmarks" / "results", ROOT / "docs" / "task_results.md", "images/task_results.png"
COLORS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY)
HEAD = """# Results in the tasks

`python -m benchmarks.tasks --draw` makes this page from the cards in `benchmarks/results/`. `--missing` makes the cards
that do not exist, one after another, and goes on where it was stopped.

- **Success** is the share of the episodes of a task's test in which the rover reaches the goal in time and its body
  touches nothing. Policies act without exploration.
- Over several **seeds**, it is the interquartile mean with its 95 % interval, a stratified bootstrap over the seeds
  ([Agarwal et al., 2021](https://arxiv.org/abs/2108.13264)), which is too narrow with three. Of one seed and of
  planners, it is that of all episodes, with its Wilson interval.
- **Touched** is the share of episodes that come within 1 cm of an obstacle, and the time that of those that succeed.
- *Planners* are not trained. `expert` knows the map, which no learner does. An entry **with planner** has one in its
  network or in its action. Learners of `field` and `rooms-people` imitate one in the first tenth of their training.

The first table has each entry with its largest budget in million (M) steps. The other tables have all budgets.
"""


def read_cards(folder: Path) -> list[Card]:
    return [json.loads(path.read_text()) for path in sorted(folder.glob("*/*.json"))]


def write_card(path: Path, card: Card) -> None:
    """Writes a card with a line for each value."""
    lines = [f"  {json.dumps(key)}: {json.dumps(_rounded(value))}" for key, value in card.items()]
    with written_whole(path) as temporary:
        temporary.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return None if math.isnan(value) else float(f"{value:.4g}") if abs(value) < 1e4 else round(value)
    if isinstance(value, list):
        return [*map(_rounded, value)]
    return {key: _rounded(one) for key, one in value.items()} if isinstance(value, dict) else value


def page(cards: Sequence[Card]) -> str:
    """Markdown with a table for each task, best entries first."""
    parts = [HEAD]
    if any(card["curve"] for card in cards):
        parts.append(f"![Success while exploring, over the steps of training]({PICTURE})\n")
    parts.append(_overview(grouped(cards)) if cards else "There are no cards yet.\n")
    for task, groups in grouped(cards).items():
        header = "| entry | success | 95 % | seeds | SPL | time, s | touched | steps | minutes | machine | command |"
        rows = map(_row, sorted(groups, key=lambda group: -success(group).value))
        parts.append("\n".join([f"## {task}\n", header, "|---" * 11 + "|", *rows]) + "\n")
    return "\n".join(parts)


def grouped(cards: Sequence[Card]) -> dict[str, list[list[Card]]]:
    """Cards of each task, in alphabetical order of the tasks, those that differ in their seed only together."""
    found: dict[str, dict[str, list[Card]]] = {}
    for card in sorted(cards, key=lambda card: (card["task"], card["entry"], card["seed"] or 0)):
        found.setdefault(card["task"], {}).setdefault(_command(card), []).append(card)
    return {task: [*entries.values()] for task, entries in found.items()}


def _command(card: Card) -> str:
    """Command of a card without its seed."""
    return card["command"].split(" --seed ")[0]


def _name(card: Card) -> str:
    """Name of an entry. Planners stand in italics."""
    entry = card["entry"]
    return f"*{entry}*" if card["kind"] == "planner" else entry + ", with planner" * card["with_planner"]


def _overview(tasks: dict[str, list[list[Card]]]) -> str:
    """Table of the tasks by the entries, each with its largest budget.

    The last row is that of entries that were judged in all tasks.
    """
    cells = {task: _largest(groups) for task, groups in tasks.items()}
    names = sorted({name for row in cells.values() for name in row}, key=lambda name: (name.startswith("*"), name))
    lines = ["| task |" + "".join(f" {name} |" for name in names), "|---" * (len(names) + 1) + "|"]
    for task, row in cells.items():
        lines.append(f"| [{task}](#{task}) |" + "".join(f" {_cell(row.get(name))} |" for name in names))
    if len(cells) > 1:
        everywhere = ([row.get(name) for row in cells.values()] for name in names)
        lines.append("| all |" + "".join(f" {_cell(*groups)} |" for groups in everywhere))
    return "\n".join(lines) + "\n"


def _largest(groups: Sequence[list[Card]]) -> dict[str, list[Card]]:
    """Cards of the largest budget of each entry."""
    by_steps = sorted(groups, key=lambda group: group[0]["steps"] or 0)
    return {_learner(group[0]): group for group in by_steps}


def _learner(card: Card) -> str:
    """Name of an entry without its budget, as in ppo-100M."""
    return re.sub(r"-[\d.]+M\b", "", _name(card))


def _cell(*groups: Sequence[Card] | None) -> str:
    """Success and budget of an entry; over several tasks, success and its interval."""
    known = [group for group in groups if group]
    if len(known) < len(groups):
        return ""
    value, steps = success(*known), known[0][0]["steps"]
    spread = "" if math.isnan(value.low) else f" ({value.low:.0%} to {value.high:.0%})"  # of one seed, there is none
    rest = spread if len(known) > 1 else f", {steps / 1e6:.2g} M" if steps else ""
    return f"{value.value:.0%}{rest}"


def success(*groups: Sequence[Card]) -> Estimate:
    """Success of an entry over seeds, and tasks, with its interval; of one card, over its episodes."""
    if len(groups) == len(groups[0]) == 1:
        (card,) = groups[0]
        return proportion(round(card["success"] * card["episodes"]), card["episodes"])
    return interquartile_mean([np.array([card["success"] for card in group]) for group in groups])


def _row(group: Sequence[Card]) -> str:
    def mean(key: str, style: str) -> str:
        known = [card[key] for card in group if card[key] is not None]
        return format(sum(known) / len(known), style) if known else ""

    first, value = group[0], success(group)
    seeds = ", ".join(str(card["seed"]) for card in group if card["seed"] is not None)
    styles = dict(spl=".2f", mean_time_to_traverse=".1f", body_contact_share=".0%", steps=",.0f", minutes=".0f")
    machine = f"{first['machine']['processor']}, {first['machine']['cores']} cores"
    command = f"`{_command(first)}{' --seed 1' * bool(seeds)}`"
    interval = f"{value.low:.0%} to {value.high:.0%}"
    cells = [_name(first), f"{value.value:.1%}", interval, seeds, *(mean(*style) for style in styles.items()), machine]
    return f"| {' | '.join([*cells, command])} |"


def draw(cards: Sequence[Card], path: Path) -> None:
    """Writes the page, and its picture: a panel for each task, with learning curves and a line for each planner."""
    with written_whole(path) as temporary:
        temporary.write_text(page(cards), encoding="utf-8")
    tasks = {task: groups for task, groups in grouped(cards).items() if any(group[0]["curve"] for group in groups)}
    if not tasks:
        return
    columns = min(3, len(tasks))
    rows = math.ceil(len(tasks) / columns)
    figure = Figure(figsize=(3.4 * columns, 3.1 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).flat
    learners = [group for groups in tasks.values() for group in groups if group[0]["curve"]]
    colors = dict(zip(dict.fromkeys(_learner(group[0]) for group in learners), cycle(COLORS), strict=False))
    for (task, groups), ax in zip(tasks.items(), axes, strict=False):
        levels: dict[int, list[str]] = {}
        for card in (group[0] for group in groups if group[0]["kind"] == "planner"):
            ax.axhline(card["success"], color=GREY, linewidth=0.8, linestyle=":")
            levels.setdefault(round(20 * card["success"]), []).append(card["entry"])
        for level, names in levels.items():  # names of nearly the same success share a line
            ax.text(1, level / 20, ", ".join(names), transform=ax.get_yaxis_transform(), ha="right", fontsize=6)
        for group in (group for group in groups if group[0]["curve"]):
            _draw_curve(ax, group, colors[_learner(group[0])])
        ax.set(title=task, xlabel="million steps", ylim=(0, 1.02))
        style_axes(ax)
    for ax in axes:
        ax.set_axis_off()
    handles = [figure.axes[0].plot([], [], color=color, label=name)[0] for name, color in colors.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=2 * columns, frameon=False)
    with written_whole(path.parent / PICTURE) as temporary:
        figure.savefig(temporary, dpi=100)


def _draw_curve(ax: Any, group: Sequence[Card], color: str) -> None:
    curves = [{key: np.array(values, float) for key, values in card["curve"].items()} for card in group]
    at = np.linspace(0, min(curve["steps"][-1] for curve in curves), 100)
    values = np.array([np.interp(at, one["steps"], one["success"], left=math.nan) for one in curves])
    if len(group) > 1:
        ax.fill_between(at / 1e6, *interval([values]), color=color, alpha=0.2, linewidth=0)
    ax.plot(at / 1e6, trim_mean(values, 0.25), color=color)
