"""The command ``rover-rl robots``, and URDF files as ``--robot``."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from rover_rl.algos.evaluation import evaluate
from rover_rl.algos.policy.names import resolve_policy
from rover_rl.cli.main import main
from rover_rl.cli.options import EnvOptions
from rover_rl.cli.train import train_defaults
from rover_rl.robots import RobotOptions, get_robot, robot_names
from rover_rl.sims.effective_track import measured_track
from rover_rl.tasks import get_task
from tests.robots.public_urdfs import Machine, car


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own_cache: Path) -> None:
    monkeypatch.chdir(tmp_path)


def printed(capsys: pytest.CaptureFixture[str], *args: object) -> str:
    assert main([str(arg) for arg in args]) == 0
    return capsys.readouterr().out


def test_robots_are_listed_with_mass_size_drive_and_speed(capsys: pytest.CaptureFixture[str]) -> None:
    lines = printed(capsys, "robots").splitlines()
    assert [line.split()[0] for line in lines[1:-1]] == robot_names()
    (rover,) = (line for line in lines if line.startswith("rover_zero"))
    assert "12.5 kg 0.53 x 0.45 m SkidSteer        1 m/s     in place  built in" in rover


def test_a_urdf_is_shown_as_it_was_understood(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = Machine().body().wheels((0.2, -0.2)).write(tmp_path)
    text = printed(capsys, "robots", "show", path, "--robot.max-speed", 0.8)
    for words in (
        "machine: SkidSteer, 12.4 kg",
        "wheels: 4, radius 0.1 m, 0.05 m wide",
        "limits: 0.8 m/s",
        "read as skid-steer with 4 wheels",
        "its torque is not known",
        "effective track, measured in warp: 0.8",
        "drawn in machine.robot.png",
    ):
        assert words in text
    with Image.open("machine.robot.png") as picture:
        assert len(set(picture.convert("RGB").resize((200, 128)).getdata())) > 20


def test_options_of_a_robot_are_part_of_its_name_in_all_commands() -> None:
    options = EnvOptions(robot="scout.urdf", robot_options=RobotOptions(drive="skid_steer", lidar="0 0 0.5"))
    assert options.given_robot == "scout.urdf(drive=skid_steer, lidar='0 0 0.5')"
    assert EnvOptions(robot_options=RobotOptions(max_speed=1.0)).given_robot is None
    assert train_defaults([]).config.env.robot_options == RobotOptions()


def test_a_policy_drives_with_the_robot_that_is_named_in_place_of_those_of_a_task() -> None:
    planner, race = resolve_policy("gridplanner", ("forest:1",), "racer").module, get_task("race")
    env = evaluate.test_env(race, planner)
    with pytest.raises(ValueError, match="made for the robot racer"):
        EnvOptions().description(planner, None, env)
    driven = EnvOptions(robot="racer").description(planner, None, env)
    assert (driven.robot, driven.randomization, driven.task) == ("racer", env.randomization, env.task)
    with_options = EnvOptions(robot="racer", robot_options=RobotOptions(lidar_view=2.0))
    planner = resolve_policy("gridplanner", ("forest:1",), with_options.given_robot).module
    assert with_options.description(planner, None, evaluate.test_env(race, planner)).robot == "racer(lidar_view=2.0)"


def test_a_skid_steer_robot_of_a_urdf_turns_as_it_is_commanded(tmp_path: Path) -> None:
    path = Machine(width=0.06).body().wheels((0.25, -0.25)).write(tmp_path)
    with pytest.warns(UserWarning, match="by Coulomb's law"):
        robot = get_robot(str(path))
    # Coulomb's law for thin wheels: 0.4 (1 + (0.5 / 0.4)^2).
    assert robot.drive.separation == pytest.approx(1.025, rel=0.05)
    assert measured_track(robot) == pytest.approx(robot.drive.separation, rel=0.02)


def test_only_a_skid_steer_robot_has_an_effective_track(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="Ackermann"):
        robot = get_robot(str(car().write(tmp_path)))
    with pytest.raises(ValueError, match="only a SkidSteer drive has an effective track"):
        measured_track(robot)
