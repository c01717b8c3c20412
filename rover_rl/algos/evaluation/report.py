"""Evaluation reports: tables on the terminal, JSON and CSV files."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from rich.console import Console
from rich.markup import escape

from rover_rl.algos.evaluation.metrics import METRICS, Estimate
from rover_rl.algos.evaluation.results import EndlessEvaluation, Evaluation, worst_worlds
from rover_rl.algos.evaluation.tables import Column, cell, formatted, print_tables, write_rows
from rover_rl.files import write_json
from rover_rl.registry import perhaps

DEFAULT_COLUMNS = (
    "success_rate",
    "contact_free_success_rate",
    "spl",
    "mean_time_to_traverse",
    "goals_per_episode",
    "seconds_per_goal",
    "ended_early",
    "body_contact_share",
)
"""Metrics that have a column by default, beside the endings that occur."""
ALL_COLUMNS = "all"
"""In place of the names of columns: all metrics."""
LISTED = 20
"""Largest number of printed episodes on which backends disagree."""


def print_table(
    evaluations: Sequence[Evaluation | EndlessEvaluation],
    console: Console | None = None,
    groups: Mapping[str, str] | None = None,
    columns: Sequence[str] = (),
) -> None:
    """Prints a table of policies for each world and mode, with 95 % confidence intervals below the values.

    Columns that do not fit into the width of the terminal go into a further table. Without a terminal, the width is
    that of the environment variable ``COLUMNS``, else 80. Below, for ranges of worlds, the worlds with the lowest
    success rates, and for policies in several backends, the first 20 episodes that reach their goal in one backend and
    not in another. A last paragraph explains the columns.

    Args:
        evaluations: evaluations to print, of any worlds and modes.
        console: console to print to; ``None``: standard output.
        groups: group name of each policy that belongs to a group, by the policy's name. Each group of several policies,
            such as those that differ in their seed only, has a row with its mean and standard deviation.
        columns: metrics to show, as for ``check_columns``; empty: success, contacts, SPL, time and endings.

    Raises:
        ValueError: for an unknown column.
    """
    console = console or Console()
    chosen, groups = check_columns(columns), groups or {}
    shown: dict[str, None] = {}
    for title in dict.fromkeys(evaluation.title for evaluation in evaluations):
        together = [evaluation for evaluation in evaluations if evaluation.title == title]
        keys = [key for key in chosen if key in together[0].metrics and _is_shown(key, together)]
        rows = [*_rows(together), *_group_rows(together, groups)]
        shown_columns = [
            Column(METRICS[key].heading, METRICS[key].unit, [row.cells[key] for row in rows]) for key in keys
        ]
        print_tables(title, [row.name for row in rows], shown_columns, console)
        shown |= dict.fromkeys(keys)
    for evaluation in evaluations:
        if isinstance(evaluation, Evaluation) and evaluation.episodes.several_worlds:
            console.print(_worst_worlds(evaluation), highlight=False, soft_wrap=True)
    if comparable := _comparable(evaluations):
        _print_disagreements([one for group in comparable for one in find_disagreements(group)], console)
    console.print(_legend(list(shown), evaluations, groups), style="dim", highlight=False)


def check_columns(names: Sequence[str]) -> list[str]:
    """Returns the metrics that names of columns stand for, in the order of the table."""
    if ALL_COLUMNS in names:
        return [*METRICS]
    if not names:
        return [key for key in METRICS if key in DEFAULT_COLUMNS or key.startswith(_ENDING)]
    known = {metric.heading: key for key, metric in METRICS.items()} | {key: key for key in METRICS}
    for name in names:
        if name not in known:
            raise ValueError(
                f"unknown column {name!r}{perhaps(name, known)}; use {ALL_COLUMNS} or some of {[*METRICS]}"
            )
    chosen = {known[name] for name in names}
    return [key for key in METRICS if key in chosen]


def _worst_worlds(evaluation: Evaluation) -> str:
    """Returns a line with the worlds that have the lowest success rates."""
    worlds = {world["world"]: world for world in evaluation.by_world}
    worst = (worlds[index] for index in worst_worlds([evaluation]))
    named = ", ".join(f"{world['name']} {world['success_rate']:.0%}" for world in worst if world["success_rate"] < 1)
    policy = escape(f"{evaluation.name} in {evaluation.world_name}, {evaluation.backend}")
    return f"Lowest success rates of {policy}: {escape(named)}" if named else f"{policy}: all episodes reach their goal"


_ENDING = "ending_"
"""First part of the names of metrics that are shares of endings."""


@dataclass(frozen=True)
class _Row:
    """Row of a table: a name, with a note in its second line, and the cell of each metric."""

    name: str
    cells: Mapping[str, str]


def _rows(evaluations: Sequence[Evaluation | EndlessEvaluation]) -> Iterator[_Row]:
    """Yields a row for each evaluation. With several backends, those of a policy stand below one another."""
    several = _several_backends(evaluations)
    order = [*dict.fromkeys(evaluation.name for evaluation in evaluations)]
    for one in sorted(evaluations, key=lambda one: order.index(one.name)):
        cells = {key: _cell(key, estimate) for key, estimate in one.metrics.items()}
        yield _Row(f"{one.name}\n{one.backend}" if several else one.name, cells)


def _group_rows(evaluations: Sequence[Evaluation | EndlessEvaluation], groups: Mapping[str, str]) -> Iterator[_Row]:
    """Yields a row for each group of several policies, in each backend, with means and standard deviations."""
    several = _several_backends(evaluations)
    places = dict.fromkeys((groups[one.name], one.backend) for one in evaluations if one.name in groups)
    for group, backend in places:
        members = [one for one in evaluations if (groups.get(one.name), one.backend) == (group, backend)]
        if len(members) > 1:
            cells = {key: _mean_cell(key, [one.metrics[key].value for one in members]) for key in members[0].metrics}
            yield _Row(f"{group}\n{len(members)} policies{f', {backend}' if several else ''}", cells)


def _legend(
    shown: Sequence[str], evaluations: Sequence[Evaluation | EndlessEvaluation], groups: Mapping[str, str]
) -> str:
    """Returns what explains the columns and the second lines of the tables, and nothing else."""
    said = [f"{METRICS[key].heading}: {METRICS[key].meaning}" for key in shown if METRICS[key].meaning]
    endings = [METRICS[key].heading for key in shown if key.startswith(_ENDING)]
    said += [f"{', '.join(endings)}: episodes that end so"] if endings else []
    below = []
    if any(not math.isnan(one.metrics[key].low) for one in evaluations for key in shown if key in one.metrics):
        below.append("95 % confidence interval")
    if any(True for _ in _group_rows(evaluations, groups)):
        below.append("± standard deviation of several policies")
    return "; ".join(said) + (f". Below a value: {', '.join(below)}." if below else ".")


def _print_disagreements(disagreements: Sequence[Disagreement], console: Console) -> None:
    """Prints the first episodes on which backends disagree."""
    if not disagreements:
        console.print("The backends agree on which episodes reach their goal.")
        return

    def numbers(values: Sequence[float]) -> str:
        return ", ".join(f"{value:.2f}" for value in values)

    shown = disagreements[:LISTED]
    columns = [
        Column("episode", "", [str(one.episode) for one in shown]),
        Column("start", "x, y, yaw", [numbers(one.start) for one in shown]),
        Column("goal", "x, y", [numbers(one.goal) for one in shown]),
    ]
    for backend in dict.fromkeys(backend for one in shown for backend in one.endings):
        columns.append(Column(backend, "", [one.endings.get(backend, "-") for one in shown]))
    title = "Episodes that reach their goal in one backend and not in another"
    print_tables(title, [f"{one.policy}\n{one.world}" for one in shown], columns, console)
    if len(disagreements) > LISTED:
        console.print(f"{len(disagreements) - LISTED} more such episodes: see evaluation.json.")


def _is_shown(key: str, evaluations: Sequence[Evaluation | EndlessEvaluation]) -> bool:
    """Whether a metric has a column: false for undefined metrics and for endings that do not occur."""
    values = [evaluation.metrics[key].value for evaluation in evaluations]
    return any(value > 0 for value in values) or not (key.startswith(_ENDING) or all(map(math.isnan, values)))


def _cell(key: str, estimate: Estimate) -> str:
    """Formats a value and its confidence interval. Endings have none, as there are many of them."""
    shown = Estimate(estimate.value, math.nan, math.nan) if key.startswith(_ENDING) else estimate
    return cell(shown, METRICS[key].unit)


def _mean_cell(key: str, values: Sequence[float]) -> str:
    """Formats the mean of several policies and, below it, their standard deviation; ``-`` if a value is undefined."""
    mean, deviation = torch.tensor(values).mean().item(), torch.tensor(values).std().item()
    unit = METRICS[key].unit
    return "-" if math.isnan(mean) else f"{formatted(mean, unit)}\n± {formatted(deviation, unit)}"


def write_evaluation(path: Path, evaluations: Sequence[Evaluation | EndlessEvaluation]) -> None:
    """Writes evaluations as a JSON file with everything, and as CSV files.

    ``evaluation.csv`` has a row for each episode, ``evaluation-summary.csv`` a row for each evaluation with all
    metrics and their intervals, and with several worlds, ``evaluation-worlds.csv`` a row for each world.

    Evaluations of a policy in several backends also list ``disagreements``: the episodes that reach their goal in one
    backend and not in another. The summary has their indices.

    Args:
        path: path of the JSON file, such as ``evaluation.json``, from which the CSV files have their names.
        evaluations: evaluations to write, of any worlds and modes.
    """
    found = {id(one): find_disagreements(group) for group in _comparable(evaluations) for one in group}
    results, rows = [], []
    for evaluation in evaluations:
        result, row = evaluation.to_json(), evaluation.summary()
        if (disagreements := found.get(id(evaluation))) is not None:
            keys = ("episode", "start", "goal", "endings")
            result["disagreements"] = [{key: getattr(one, key) for key in keys} for one in disagreements]
            row["disagreements"] = " ".join(str(one.episode) for one in disagreements)
        for key, estimate in evaluation.metrics.items():
            row |= {key: estimate.value, f"{key}_low": estimate.low, f"{key}_high": estimate.high}
        results.append(result)
        rows.append(row)
    write_json(path, results)
    write_rows(path.with_suffix(".csv"), [row for one in evaluations for row in one.episode_rows()])
    write_rows(path.with_name(f"{path.stem}-summary.csv"), rows)
    by_world = [
        {"policy": one.name, "backend": one.backend, "worlds": one.world_name, **world}
        for one in evaluations
        if isinstance(one, Evaluation) and one.episodes.several_worlds
        for world in one.by_world
    ]
    if by_world:
        write_rows(path.with_name(f"{path.stem}-worlds.csv"), by_world)


@dataclass(frozen=True)
class Disagreement:
    """An episode that reaches its goal in one backend and not in another.

    Attributes:
        policy: name of the policy.
        world: name of the world.
        episode: index of the episode in its set, from 0.
        start: start pose: x, y (m) and yaw (rad).
        goal: goal: x, y, m.
        endings: ending of the episode in each backend, by name.
    """

    policy: str
    world: str
    episode: int
    start: tuple[float, ...]
    goal: tuple[float, ...]
    endings: dict[str, str]


def find_disagreements(group: Sequence[Evaluation]) -> list[Disagreement]:
    """Finds the episodes that reach their goal in one backend and not in another.

    Args:
        group: evaluations of a policy on the same episodes, one for each backend.
    """
    reached, episodes = torch.stack([evaluation.reached for evaluation in group]), group[0].episodes
    return [
        Disagreement(
            policy=group[0].name,
            world=episodes.world_name(episode),
            episode=episode,
            start=tuple(episodes.start[episode].tolist()),
            goal=tuple(episodes.goal[episode].tolist()),
            endings={evaluation.backend: evaluation.endings[episode] for evaluation in group},
        )
        for episode in (reached.any(0) & ~reached.all(0)).nonzero().squeeze(-1).tolist()
    ]


def _several_backends(evaluations: Sequence[Evaluation | EndlessEvaluation]) -> bool:
    """Whether a policy is in several backends."""
    places = {(evaluation.name, evaluation.backend) for evaluation in evaluations}
    return len(places) > len({name for name, _ in places})


def _comparable(evaluations: Sequence[Evaluation | EndlessEvaluation]) -> list[list[Evaluation]]:
    """Groups of evaluations of a policy on the same episodes, one for each of several backends.

    Episodes in endless mode are not compared, since their goals depend on the goals before.
    """
    groups: list[list[Evaluation]] = []
    for evaluation in evaluations:
        if not isinstance(evaluation, Evaluation):
            continue
        fitting = (
            group
            for group in groups
            if _same_episodes(group[0], evaluation) and evaluation.backend not in {one.backend for one in group}
        )
        if (group := next(fitting, None)) is None:
            groups.append([evaluation])
        else:
            group.append(evaluation)
    return [group for group in groups if len(group) > 1]


def _same_episodes(one: Evaluation, other: Evaluation) -> bool:
    """Whether two evaluations are of a policy of the same name on the same episodes with the same time limit."""
    if any(getattr(one, key) != getattr(other, key) for key in ("name", "world_name", "title", "action_repeat")):
        return False
    a, b = one.episodes, other.episodes
    return all(torch.equal(getattr(a, key), getattr(b, key)) for key in ("start", "goal", "world_index"))
