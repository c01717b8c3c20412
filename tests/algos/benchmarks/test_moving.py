"""DynaBARN and ros_jackal: reading, the rules of a run, what was hit, groups, and the commands."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from rover_rl.algos.benchmarks.dynabarn import DynaBarn, read_dynabarn
from rover_rl.algos.benchmarks.ros_jackal import RosJackal, read_ros_jackal
from rover_rl.algos.benchmarks.suite import run_suite
from rover_rl.cli import main
from rover_rl.envs import EnvConfig
from tests.algos.benchmarks.moving import AWAY, dynabarn, ros_jackal, write
from tests.algos.drivers import standing, straight

WARP = EnvConfig(backend="warp")


def test_worlds_of_dynabarn(tmp_path: Path) -> None:
    courses = read_dynabarn(write(tmp_path / "d.json", dynabarn()))
    assert [(course.number, course.group) for course in courses] == [(0, "easy"), (3, "easy"), (21, "medium")]
    assert {len(course.world.movers) for course in courses} == {1, 2, 15}
    assert courses[0].start == (11.0, 0.0, math.pi)
    assert courses[0].goal == (-9.0, 0.0)
    assert courses[0].length == 20
    points = [(-10.05, 0, 0.5), (0, 10.05, 0.5), (0, -10.05, 0.5), (10.05, 0, 0.5), (-9, 9, 0.5), (0, 0, 0.5)]
    inside = courses[0].world.inside(torch.tensor(points, dtype=torch.float64))
    assert inside.tolist() == [True, True, True, False, False, False]
    coming = courses[1].world.movers[1]
    # At rest until the period is over.
    assert coming.motion.keys[-1] == (10.0, 16.0, 0.0, 3.14)  # type: ignore[attr-defined]
    assert coming.shape.parts()[0].size[0] == 1.0
    for worlds, number in (([["away"]], 0), ({"world_17": [AWAY]}, 17)):
        assert read_dynabarn(write(tmp_path / "l.json", {**dynabarn(), "worlds": worlds}))[0].number == number


def test_cylinders_of_dynabarn_may_begin_in_a_wall_and_pass_it(tmp_path: Path) -> None:
    # As in the published worlds, one begins on the line of a wall and crosses the yard, and one beyond it.
    across = {"period": 20.0, "keys": [[0.0, 4.0, 10.05, 0.0], [10.0, 4.0, -12.0, 0.0]]}
    content = {**dynabarn(), "motions": {"away": AWAY, "across": across}, "worlds": [["away", "across"]]}
    with pytest.warns(UserWarning, match="dynabarn-0: movers start inside an .* through it: cylinder 1"):
        courses = read_dynabarn(write(tmp_path / "d.json", content))
    suite = DynaBarn(courses)
    suite.seconds = 8.0
    (result,) = run_suite(suite, {"standing": (standing, WARP)})
    assert result.evaluation.trajectories[0].ending == "time limit"


def test_worlds_of_ros_jackal(tmp_path: Path) -> None:
    courses = read_ros_jackal(write(tmp_path / "r.json", ros_jackal()), [300, 400])
    assert [(course.number, course.group) for course in courses] == [(300, "boxes"), (400, "walls")]
    assert courses[0].world.movers[0].shape.parts()[0].size == (0.4, 0.6, 1.0)
    middles = torch.tensor([(-3.0, 4.0, 0.9), (-3.0, 4.5, 0.9)], dtype=torch.float64)
    assert courses[1].world.inside(middles).tolist() == [True, False]


def test_the_first_contact_ends_a_run_and_is_named(tmp_path: Path) -> None:
    courses = read_ros_jackal(write(tmp_path / "r.json", ros_jackal()))
    (result,) = run_suite(RosJackal(courses), {"straight": (straight, WARP)})
    boxes, free, walls = result.evaluation.trajectories
    assert (boxes.ending, free.ending, walls.ending) == ("contact", "goal", "contact")
    # Rover and box meet in the middle of 5 m less their half lengths, at twice 1 m/s; the rover starts from rest.
    assert boxes.seconds == pytest.approx((5 - 0.27 - 0.2) / 2, abs=0.25)
    # 1 m to the cylinders, less half a rover.
    assert walls.position[-1, 1].item() == pytest.approx(4 - 0.075 - 0.27, abs=0.05)
    rates = {key: result.metrics[key].value for key in ("success_rate", "mover_rate", "wall_rate", "time_limit_rate")}
    assert rates == {key: pytest.approx(value) for key, value in zip(rates, (1 / 3, 1 / 3, 1 / 3, 0), strict=True)}
    groups = result.groups()
    assert list(groups) == ["boxes", "walls"]
    assert groups["boxes"].name == "straight, boxes"
    assert groups["boxes"].metrics["mover_rate"].value == 0.5
    assert groups["walls"].metrics["wall_rate"].value == 1


def test_a_mover_that_hits_a_standing_rover_ends_its_run(tmp_path: Path) -> None:
    courses = read_dynabarn(write(tmp_path / "d.json", dynabarn()), [0, 3])
    suite = DynaBarn(courses)
    suite.seconds = 8.0
    (result,) = run_suite(suite, {"standing": (standing, WARP)})
    free, hit = result.evaluation.trajectories
    assert (free.ending, hit.ending) == ("time limit", "contact")
    # From 6 m to the rover's rear at 11 m less its half length and the radius, at 2 m/s.
    assert hit.seconds == pytest.approx((11 - 0.27 - 0.5 - 6) / 2, abs=0.1)
    assert result.metrics["mover_rate"].value == 0.5


@pytest.mark.parametrize(
    ("command", "content", "groups"),
    [("dynabarn", dynabarn, {"easy", "medium"}), ("ros-jackal", ros_jackal, {"boxes", "walls"})],
)
def test_the_commands(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    command: str,
    content: Callable[[], dict[str, Any]],
    groups: set[str],
) -> None:
    data = write(tmp_path / "data.json", content())
    out = tmp_path / "out"
    given = ["benchmark", command, "--data", str(data), "--backend", "warp", "--workers", "1", "--out", str(out)]
    assert main([*given, "scripted"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "What differs from the original benchmark:" in text
    assert "Contact: as the simulator tells it at 20 Hz" in text
    results = json.loads((out / "benchmark.json").read_text())
    (policy,) = results["policies"]
    assert policy["groups"].keys() == groups
    with (out / "benchmark.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["world"]) for row in rows] == [*map(int, content()["worlds"])]
    assert (out / "worst-scripted.png").exists()


def without(content: dict[str, Any], key: str) -> dict[str, Any]:
    return {name: value for name, value in content.items() if name != key}


@pytest.mark.parametrize(
    ("read", "content", "message"),
    [
        (read_dynabarn, [], "must have worlds, and motions by name"),
        (read_dynabarn, without(dynabarn(), "motions"), "must have worlds, and motions by name"),
        (read_dynabarn, without(dynabarn(), "cylinder_radius"), "cylinder_radius in .* must be 1 finite numbers"),
        (read_dynabarn, {**dynabarn(), "worlds": {"one": ["away"]}}, "must be a list, or named by different numbers"),
        (read_dynabarn, {**dynabarn(), "worlds": {"1": "away"}}, "world 1 of .* must be a list of motions"),
        (read_dynabarn, {**dynabarn(), "worlds": [["x"]]}, "has no motion 'x'"),
        (read_dynabarn, {**dynabarn(), "motions": {"away": {"keys": []}}}, "'away' of .* must have a period and keys"),
        (
            read_dynabarn,
            {**dynabarn(), "worlds": [["away"]], "motions": {"away": {"period": 1.0, "keys": [[0, 0, 0]]}}},
            "motion 'away' of .* is wrong: keyframes must be finite",
        ),
        (read_ros_jackal, {**ros_jackal(), "worlds": {"300": {}}}, "world 300 of .* must have movers"),
        (
            read_ros_jackal,
            {**ros_jackal(), "worlds": {"300": {"movers": [{"motion": "up", "size": [1, 1]}]}}},
            "the size of mover 0 of world 300 in .* must be 3 finite numbers",
        ),
    ],
)
def test_wrong_files_are_refused_in_a_sentence(
    tmp_path: Path, read: Callable[[Path], object], content: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        read(write(tmp_path / "data.json", content))
    assert "\n" not in str(caught.value)


def test_missing_files_and_worlds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no file at"):
        read_dynabarn(tmp_path / "none.json")
    with pytest.raises(ValueError, match="lacks world 5: it has 0 to 21"):
        read_dynabarn(write(tmp_path / "d.json", dynabarn()), [5])
