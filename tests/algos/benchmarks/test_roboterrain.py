"""RoboTerrain: time close to people and time, per goal, and the published figures beside them."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from rover_rl.algos.benchmarks.roboterrain import (
    RoboTerrain,
    print_roboterrain,
    read_roboterrain,
    run_roboterrain,
    write_roboterrain,
)
from rover_rl.algos.policy.baselines import ScriptedPolicy
from rover_rl.envs import EnvConfig
from rover_rl.worlds import Terrain, World
from rover_rl.worlds.movers import Mover, Person, Waypoints
from tests.algos.drivers import standing

WARP = EnvConfig(backend="warp")


@pytest.fixture
def world() -> World:
    """A person who comes to 0.38 m from the middle of the start and stays for 2 of 4 s, and free ground around."""
    keys = [(0.0, 3.0, 0.0, 3.14), (1.0, 0.38, 0.0, 3.14), (3.0, 0.38, 0.0, 3.14), (4.0, 3.0, 0.0, 0.0)]
    at_start = ((-0.1, 0.1), (-0.1, 0.1))
    return World(
        "yard",
        Terrain.flat((16.0, 16.0)),
        spawn_range=at_start,
        goal_range=((-6.0, 6.0), (-6.0, 6.0)),
        movers=[Mover(Waypoints(keys, repeat="loop"), Person())],
    )


def test_time_close_to_people_is_counted(world: World) -> None:
    suite = RoboTerrain({"yard": world}, rovers=2, seconds=8.0)
    (run,) = run_roboterrain(suite, {"standing": (standing, WARP)}, workers=1)
    # Close for 2 s and a little more while coming and going, twice.
    assert run.goals.tolist() == [0, 0]
    assert 3.5 < run.risk.min() <= run.risk.max() < 5.5
    assert run.seconds == 8


def test_goals_follow_one_another_and_published_figures_are_shown(world: World, tmp_path: Path) -> None:
    suite = RoboTerrain({"inspect_1": world}, rovers=3, seconds=30.0)
    runs = run_roboterrain(suite, {"scripted": (ScriptedPolicy(), WARP)}, workers=1)
    assert runs[0].goals.min() >= 1
    assert runs[0].goals.sum() >= 4
    time = runs[0].metrics["time"].value
    assert time == pytest.approx(90 / runs[0].goals.sum().item())
    console = Console(file=io.StringIO(), width=160)
    print_roboterrain(suite, runs, console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "Nav2 (lidar," in text
    assert "0.542" in text
    assert "0.352" not in text
    write_roboterrain(tmp_path / "r.json", suite, runs)
    (result,) = json.loads((tmp_path / "r.json").read_text())["results"]
    assert result["metrics"]["time"]["value"] == pytest.approx(time)
    assert len((tmp_path / "r.csv").read_text().splitlines()) == 4


def test_folders_without_walkers_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no folder at"):
        read_roboterrain(tmp_path / "none")
    (tmp_path / "robot.sdf").write_text("<sdf version='1.8'><model name='robot'/></sdf>")
    with pytest.raises(ValueError, match="has no SDF file of a world with an actor that moves"):
        read_roboterrain(tmp_path)
