"""JaxNav: levels, the rules of a run, the worst levels, and reports."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.image import imread

from rover_rl.algos.benchmarks.jaxnav import JaxNav, read_jaxnav
from rover_rl.algos.benchmarks.suite import Course, Result, print_results, run_suite
from rover_rl.algos.evaluation.results import Evaluation
from rover_rl.cli import main
from rover_rl.robots import get_robot
from tests.algos.benchmarks.mini import levels, write_levels
from tests.algos.drivers import standing
from tests.algos.evaluation.drives import WARP, csv_rows, line, printed


@pytest.fixture
def courses(tmp_path: Path) -> list[Course]:
    return read_jaxnav(write_levels(tmp_path / "levels.npz"))[0]


def test_levels_with_a_way_to_the_goal(tmp_path: Path) -> None:
    courses, unsolvable = read_jaxnav(write_levels(tmp_path / "levels.npz"))
    assert unsolvable == 1
    assert [course.number for course in courses] == [0, 1]
    assert courses[1].length == pytest.approx(4.8284273)
    cells = torch.cartesian_prod(torch.arange(5) + 0.5, torch.arange(5) + 0.5).double()
    points = torch.nn.functional.pad(cells, (0, 1), value=0.5)
    for course, walls in zip(courses, levels()["map_data"], strict=False):
        expected = torch.tensor([bool(walls[int(y), int(x)]) for x, y in cells.tolist()])
        assert torch.equal(course.world.inside(points), expected)
        assert len(course.world.obstacles) <= 6


def test_nothing_but_contact_goal_and_time_ends_a_run(tmp_path: Path) -> None:
    # Beside a wall, the lidar reads less than 0.3 m from the start on, which jams the rover in the task.
    arrays = levels()
    start, theta = arrays["start_xy"].copy(), arrays["start_theta"].copy()
    start[0] = (1.3, 1.5)
    theta[0] = math.pi / 2
    path = write_levels(tmp_path / "levels.npz", start_xy=start, start_theta=theta)
    suite = JaxNav(read_jaxnav(path)[0][:1], seconds=31.0)
    (result,) = run_suite(suite, {"standing": (standing, WARP)})
    (run,) = result.evaluation.trajectories
    assert run.collision.all()
    assert (run.ending, run.seconds) == ("time limit", 31.0)
    assert result.metrics.keys() == suite.columns.keys()
    assert result.metrics["time_limit_rate"].value == 1


def result_of(suite: JaxNav, endings: list[str]) -> Result:
    """Result of straight runs over 1 m with the given endings."""
    episodes = suite.episodes(get_robot("rover_zero"))
    return Result(suite, Evaluation("mine", episodes, 1, 50.0, [line(ending) for ending in endings]))


def test_the_worst_levels_are_chosen_by_the_even_runs_and_scored_by_the_odd_ones(courses: list[Course]) -> None:
    # Level 1 fails in the even runs and succeeds in the odd ones; level 0 succeeds in half of each.
    endings = ["goal", "contact", "time limit", "goal", "contact", "goal", "contact", "goal"]
    suite = JaxNav(courses, runs=4)
    values = {key: estimate.value for key, estimate in result_of(suite, endings).metrics.items()}
    expected = {"worst_levels": 1, "success_rate": 1 / 2, "contact_rate": 3 / 8, "time_limit_rate": 1 / 8}
    assert {key: values[key] for key in expected} == pytest.approx(expected)
    assert values["mean_time"] == 1
    # Worse in the odd runs does not count for the choice.
    chosen = result_of(suite, ["goal", "goal", "contact", "goal", "goal", "contact", "goal", "contact"]).metrics
    assert chosen["worst_levels"].value == 1
    assert math.isnan(result_of(JaxNav(courses), ["goal", "goal"]).metrics["worst_levels"].value)


def test_the_score_of_a_run_is_its_success_weighted_by_path_length(courses: list[Course]) -> None:
    result = result_of(JaxNav(courses, goal_radius=0.5), ["goal", "contact"])
    # A level of 2 m less the radius is longer than the path of 1 m.
    assert result.scores.tolist() == [[1.0], [0.0]]
    longer = result_of(JaxNav(courses, goal_radius=1.5), ["goal", "goal"])
    assert longer.scores.tolist() == [[pytest.approx(0.5)], [1.0]]


def test_the_table_says_what_differs(courses: list[Course]) -> None:
    results = [result_of(JaxNav(courses, unsolvable=3, runs=1, goal_radius=0.5), ["goal", "contact"])]
    text = printed(print_results, results, 120)
    for expected in (
        "JaxNav: 2 levels, one run each; goal within 0.5 m and 50 s, any contact fails",
        "50.0",
        "Robot: rover_zero, 0.53 x 0.45 m, up to 1 m/s",
        "Limits: goal radius 0.5 m and 50 s (JaxNav: 0.3 m and 50 s).",
        "The worst 10 % of the levels need two runs or more",
        "Left out: 3 levels without a path",
    ):
        assert expected in text


def test_the_command_writes_tables_and_the_worst_runs(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    data = write_levels(tmp_path / "levels.npz")
    given = ["benchmark", "jaxnav", "--data", str(data), "--backend", "warp", "--seconds", "1", "--workers", "1"]
    assert main([*given, "--runs", "2", "--out", str(tmp_path), "scripted", "random"]) == 0
    text = capsys.readouterr().out
    assert "What differs from the original benchmark:" in text
    assert f"Results: {tmp_path / 'benchmark.json'}, benchmark.csv" in text
    results = json.loads((tmp_path / "benchmark.json").read_text())
    assert (results["benchmark"], results["worlds"], results["runs"]) == ("JaxNav", [0, 1], 2)
    assert [policy["policy"] for policy in results["policies"]] == ["scripted", "random"]
    assert all(set(policy["metrics"]) == {*JaxNav.columns} for policy in results["policies"])
    runs = [(row["policy"], row["world"], row["run"]) for row in csv_rows(tmp_path / "benchmark.csv")]
    assert runs == [(policy, *run) for policy in ("scripted", "random") for run in ("00", "01", "10", "11")]
    assert imread(tmp_path / "worst-random.png").std() > 0.05


def edited(name: str, index: Any, value: float) -> dict[str, np.ndarray]:
    array = levels()[name].copy()
    array[index] = value
    return {name: array}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goal_xy": None}, "has no array 'goal_xy'; it needs map_data, start_xy"),
        ({"goal_xy": np.zeros((2, 2))}, "must have an entry for each level, got {'map_data': 3"),
        (edited("map_data", (0, 2, 2), 7), "the map of level 0 of .* must be 0 or 1 in 3 x 3 to 100 x 100 cells"),
        (edited("map_data", (1, 0, 2), 0), "the map of level 1 of .* must have walls all around"),
        (edited("goal_xy", (0, 0), 4.5), r"the goal \(4.5, 1.5\) of level 0 of .* is not in a free cell"),
        (edited("start_theta", 0, math.inf), "level 0 of .* must have a finite start_theta"),
        (edited("geodesic8", 1, -1), "level 1 of .* must have .* a geodesic8 of at least 0"),
        (edited("geodesic8", slice(None), math.inf), "has no level with a path from its start to its goal"),
    ],
)
def test_wrong_levels_are_refused_in_a_sentence(
    tmp_path: Path, changes: dict[str, np.ndarray | None], message: str
) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        read_jaxnav(write_levels(tmp_path / "levels.npz", **changes))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("benchmark barn --data x scripted --worlds 3-1", "--worlds takes test, train, all, or numbers below 300"),
        ("benchmark jaxnav --data x scripted", "no file at x"),
        ("benchmark jaxnav --data LEVELS --goal-radius 0 scripted", "goal_radius must be at least 0.05"),
        ("benchmark jaxnav --data LEVELS", "name a policy: the folder of a run, a checkpoint"),
    ],
)
def test_a_wrong_command_is_refused_in_one_line(
    failed: Callable[..., str], tmp_path: Path, line: str, expected: str
) -> None:
    data = write_levels(tmp_path / "levels.npz")
    assert failed(*line.replace("LEVELS", str(data)).split()).startswith(f"rover-rl: {expected}")
