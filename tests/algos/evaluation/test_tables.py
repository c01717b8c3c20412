"""Tables fit the console, and no number or name in them is cut."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
from dataclasses import replace
from functools import lru_cache

import pytest
import torch
from rich.console import Console

from rover_rl import World
from rover_rl.algos.benchmarks.barn import Barn
from rover_rl.algos.benchmarks.report import print_results
from rover_rl.algos.benchmarks.suite import Course, Result, open_world
from rover_rl.algos.evaluation.episodes import EpisodeSet
from rover_rl.algos.evaluation.evaluate import Evaluation
from rover_rl.algos.evaluation.metrics import METRICS, Trajectory
from rover_rl.algos.evaluation.report import choose_columns, print_table
from rover_rl.algos.evaluation.tables import fold
from rover_rl.cli import main
from rover_rl.envs import EnvConfig
from rover_rl.sims.worlds import Terrain
from rover_rl.sims.worlds.pool import WorldPool

NAMES = ("anywhere", "gridplanner", "my-long-run-name-with-seed-12", "scripted", "runs/ppo-maze/checkpoint.pt", "dwa")
RANGES = ("maze:10000-10063", "forest:10000-10063@0.2-0.8")
ENDINGS = ("goal", "time limit", "goal", "jammed", "goal", "stuck", "out of bounds", "flipped", "goal", "goal", "goal")
COUNT = len(ENDINGS)
POOL = WorldPool(*(World(f"field {number}", Terrain.flat((9.0, 9.0))) for number in range(2)))


def drive(ending: str, steps: int) -> Trajectory:
    """A drive of 1 m."""
    path = torch.stack((torch.linspace(0, 1, steps + 1), torch.zeros(steps + 1), torch.zeros(steps + 1)), -1)
    none = torch.zeros(steps, dtype=torch.bool)
    return Trajectory(path, torch.zeros(steps + 1, 3), none, none, ending)


@lru_cache
def evaluation(name: str, place: str, backend: str = "warp", endings: tuple[str, ...] = ENDINGS) -> Evaluation:
    start, index = torch.zeros(COUNT, 3), torch.arange(COUNT) % 2
    episodes = EpisodeSet(place, POOL, 0, start, torch.ones(COUNT, 2), torch.full((COUNT,), 0.9), world_index=index)
    driven = [drive(ending, 200 + 20 * number) for number, ending in enumerate(endings)]
    return Evaluation(name, episodes, 1, 60.0, driven, EnvConfig(backend=backend))


def told(width: int, terminal: bool, results: list[Evaluation], columns: tuple[str, ...] = ()) -> list[str]:
    console = Console(file=io.StringIO(), width=width, force_terminal=terminal)
    print_table(results, console, columns=columns)
    plain = re.sub("\x1b\\[[0-9;]*m", "", console.file.getvalue())  # type: ignore[attr-defined]
    return plain.splitlines()


def expected_cells(result: Evaluation, keys: list[str]) -> set[str]:
    """The values of percentages with a decimal, and their intervals, as words of a table."""
    cells: set[str] = set()
    for key in keys:
        estimate = result.metrics[key]
        if METRICS[key].unit == "%":
            cells |= {f"{100 * estimate.value:.1f}", f"{100 * estimate.low:.0f}–{100 * estimate.high:.0f}"}
    return cells


@pytest.mark.parametrize("terminal", [True, False])
@pytest.mark.parametrize("width", [60, 80, 120])
@pytest.mark.parametrize("count", [1, 3, 6])
@pytest.mark.parametrize("columns", [(), ("all",)])
def test_no_number_or_name_is_cut(terminal: bool, width: int, count: int, columns: tuple[str, ...]) -> None:
    results = [evaluation(name, place) for name in NAMES[:count] for place in RANGES]
    lines = told(width, terminal, results, columns)
    assert max(map(len, lines)) <= width
    words = " ".join(lines).split()
    assert expected_cells(results[0], ["success_rate", "body_contact_share", "ending_stuck"]) <= set(words)
    low, high = (f"{end:.2f}" for end in (results[0].metrics["spl"].low, results[0].metrics["spl"].high))
    assert f"{low}–{high}" in words
    joined = "".join(line.split("  ")[0] if line[:1] != " " else line[2:].split("  ")[0] for line in lines)
    for name in (*NAMES[:count], *RANGES):
        assert name in joined.replace(" ", "")
    text = " ".join(lines)
    assert ("jerk: root mean square" in text) == bool(columns)
    assert "What is lower than the wheel hubs, such as rubble, is ground." in text


def test_the_usual_table_is_one_at_80_columns() -> None:
    usual = ("goal",) * 7 + ("time limit", "jammed", "stuck", "goal")
    lines = told(80, False, [evaluation(name, RANGES[0], endings=usual) for name in NAMES])
    assert sum(line.startswith("policy ") for line in lines) == 1


def test_the_legend_explains_what_is_shown_and_nothing_else() -> None:
    results = [evaluation("dwa", RANGES[0])]
    legend = " ".join(told(200, False, results, ("SPL", "jerk"))[-1:])
    assert legend.startswith("SPL: success weighted by path length; jerk: root mean square jerk")
    assert "contact" not in legend
    # One episode has no interval.
    single = replace(results[0].select([0]), name="one")
    assert "interval" not in " ".join(told(200, False, [single], ("time",)))


def test_columns_are_chosen_by_heading_or_key(capsys: pytest.CaptureFixture[str]) -> None:
    assert choose_columns(["SPL", "success", "time limit"]) == ("spl", "success_rate", "ending_time_limit")
    assert choose_columns(["all"]) == tuple(METRICS)
    assert main(["evaluate", "scripted", "--columns", "speed"]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("rover-rl: --columns takes all, or some of success, clean, SPL, time")
    assert captured.err.count("\n") == 1
    assert len({metric.heading for metric in METRICS.values()}) == len(METRICS)


def test_names_are_folded_at_separators() -> None:
    assert fold("my-long-run-name-with-seed-12", 16) == ["my-long-run-", "name-with-seed-", "12"]
    assert fold("  forest:10000-10063@0.2-0.8", 16) == ["  forest:10000-", "  10063@0.2-0.8"]
    assert fold("withoutanyseparator", 5) == ["withoutanyseparator"]


@pytest.mark.parametrize("width", [80, 120])
def test_tables_of_benchmarks_fit(width: int) -> None:
    world = open_world("open", [], torch.tensor([[0.0, 0.0], [3.0, 3.0]]).numpy())
    courses = [Course(number, world, (0.0, 0.0, 0.0), (1.0, 0.0), 1.0) for number in range(COUNT)]
    results = [Result(Barn(courses), evaluation(name, "BARN")) for name in NAMES]
    console = Console(file=io.StringIO(), width=width)
    print_results(results, console)
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert max(map(len, lines)) <= width
    assert f"{100 * results[0].metrics['success_rate'].value:.1f}" in " ".join(lines).split()


PRINTED = """
from tests.algos.evaluation.test_tables import RANGES, evaluation, print_table
print_table([evaluation("dwa", place) for place in RANGES])
"""


def test_columns_of_the_environment_count_without_a_terminal() -> None:
    for width, tables in ((80, 2), (120, 1)):
        environment = os.environ | {"COLUMNS": str(width)}
        done = subprocess.run([sys.executable, "-c", PRINTED], env=environment, capture_output=True, text=True)
        assert done.stdout.count("policy ") == tables, done.stderr
        assert max(map(len, done.stdout.splitlines())) <= width
