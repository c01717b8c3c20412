from __future__ import annotations

import math
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch

from rover_rl.sims.ros2 import PoseResetError, RobotLostError, Ros2Settings
from rover_rl.sims.ros2.poses import Placer, TargetPose, place_in_gazebo
from rover_rl.worlds import get_world
from tests.sims.ros2.wire import ALL, Wire, drive, simulator, yaw_of

START = torch.tensor([[-3.0, 4.0, 2.0]])


def test_reset_stops_the_rover_and_moves_it_to_the_pose(wire, rover):
    sim = simulator()
    drive(sim, steps=2)
    assert rover.speed > 0
    state = sim.reset(ALL, START)
    assert state.position[0, :2].tolist() == [-3.0, 4.0]
    assert yaw_of(state) == pytest.approx(2.0, abs=1e-5)
    assert (rover.speed, rover.turn) == (0.0, 0.0)
    placed = wire.sent["/rover/set_pose"][-1].pose.position
    assert placed.z == pytest.approx(get_world("maze").drop_height(START[0, :2]).item())


@pytest.mark.parametrize(
    ("moved", "message"),
    [
        ({}, r"rest at x -3.00 m, y 4.00 m; after 0.3 s it is at x 1.00 m, y 2.00 m"),
        ({"x": -3.0, "y": 4.0}, r"it is at x -3.00 m, y 4.00 m"),
        ({"x": -3.0, "y": 4.0, "yaw": 2.0, "climb": -1.0}, r"z -\d+\.90 m, and its wheels are at rest"),
    ],
)
def test_reset_fails_if_the_rover_does_not_come_to_rest_at_the_pose(wire, rover, moved, message):
    wire.receivers["/rover/set_pose"] = [lambda msg: vars(rover).update(moved)]
    with pytest.raises(PoseResetError, match=message):
        simulator(reset_timeout=0.3, settle=0.2).reset(ALL, START)


def test_reset_fails_if_the_rover_is_lost(wire, rover):
    sim = simulator(step_timeout=0.3)
    wire.receivers["/rover/set_pose"] = [lambda msg: wire.rovers.clear()]
    with pytest.raises(RobotLostError, match=r"the last message is \d+.\d s old"):
        sim.reset(ALL, START)


def test_manual_reset_prompts_without_a_time_limit(wire, rover, monkeypatch):
    asked: list[str] = []

    def put(text: str) -> str:
        asked.append(text)
        wire.sleep(0.6)
        rover.x, rover.y, rover.yaw = START[0].tolist()
        return ""

    monkeypatch.setattr("builtins.input", put)
    state = simulator(reset="manual", reset_timeout=0.5).reset(ALL, START)
    assert state.position[0, :2].tolist() == [-3.0, 4.0]
    assert asked == ["Put the rover at x -3.00 m, y 4.00 m, heading 115 degrees, and press Enter: "]


def test_automatic_reset_selects_an_available_placer(wire, rover, monkeypatch, caplog):
    monkeypatch.setattr("shutil.which", lambda command: None)
    state = simulator(reset="auto").reset(ALL, START)
    assert state.position[0, :2].tolist() == [-3.0, 4.0]  # the rover subscribes to the reset topic
    wire.receivers["/rover/set_pose"].clear()
    monkeypatch.setattr("rover_rl.sims.ros2.poses.DISCOVERY_TIMEOUT", 0.01)
    state = simulator(reset="auto").reset(ALL, torch.tensor([[1.0, 1.0, 0.0]]))
    assert state.position[0, :2].tolist() == [-3.0, 4.0]
    assert "no node subscribes to /rover/set_pose, and neither ign nor gz is installed" in caplog.text


def test_wheel_odometry_is_aligned_with_the_start_pose(rover, monkeypatch):
    rover.imu_offset = 1.1
    monkeypatch.setattr("builtins.input", lambda text: "")
    sim = simulator(pose="wheels", reset="manual")
    state = sim.reset(ALL, START)
    assert state.position[0, :2].tolist() == pytest.approx([-3.0, 4.0], abs=1e-5)
    assert yaw_of(state) == pytest.approx(2.0, abs=1e-5)
    # One meter ahead in the odometry's frame (yaw 0.5 rad) is one meter ahead in the world (yaw 2.0 rad).
    rover.x, rover.y = rover.x + math.cos(0.5), rover.y + math.sin(0.5)
    rover.yaw += 0.25
    drive(sim)
    state = sim.state()
    assert state.position[0, :2].tolist() == pytest.approx([-3.0 + math.cos(2.0), 4.0 + math.sin(2.0)], abs=1e-5)
    assert yaw_of(state) == pytest.approx(2.25, abs=1e-5)


@pytest.mark.parametrize(
    ("pose", "topic"),
    [
        ("wheels", "/none"),
        ("pose_stamped", "/pose"),
        ("odometry", "/odometry/wheels"),
        ("pose_with_covariance", "/amcl_pose"),
    ],
)
def test_odometry_and_localizers_provide_pose_and_heading_without_reset(rover, pose, topic):
    rover.imu_offset = -0.7
    sim = simulator(pose=pose, pose_topic=topic, reset="none")
    state = sim.reset(ALL, START)
    assert state.position[0, :2].tolist() == pytest.approx([1.0, 2.0], abs=1e-5)
    assert yaw_of(state) == pytest.approx(0.5, abs=1e-5)  # not that of the IMU
    rover.silent.add("localizer")  # the IMU updates the heading between its poses
    rover.yaw += 0.4
    drive(sim)
    assert yaw_of(sim.state()) == pytest.approx(0.9, abs=1e-5)


TARGET = TargetPose(1.0, -2.0, 0.75, 0.5)

# Standard output, standard error, and whether the call succeeded. The exit code is 0 for all of them.
OUTPUTS = [
    ("data: true\n\n", "", True),
    ("data: false\n", "", False),
    ("Service call timed out\n", "", False),
    ("", "Unable to create request of type[ignition.msgs.Pose].\n", False),
    ("data: true\n", "[libprotobuf ERROR google/protobuf] Error parsing text-format\n", False),
]


@pytest.fixture
def fake_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Puts an executable first on the PATH that stores its arguments and prints the given output."""

    def make(output: str = "data: true\n", errors: str = "", name: str = "ign", extra: str = "") -> Path:
        (tmp_path / "output").write_text(output)
        (tmp_path / "errors").write_text(errors)
        program = tmp_path / name
        program.write_text(
            f'#!/bin/sh\n{extra}\nprintf "%s\\n" "$@" > "{tmp_path}/arguments"\n'
            f'cat "{tmp_path}/output"; cat "{tmp_path}/errors" >&2\nexit 0\n'
        )
        program.chmod(0o755)
        monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
        return tmp_path / "arguments"

    return make


@pytest.mark.parametrize(("output", "errors", "succeeds"), OUTPUTS)
def test_only_a_successful_service_call_is_accepted(fake_command, output, errors, succeeds):
    fake_command(output, errors)
    with nullcontext() if succeeds else pytest.raises(PoseResetError, match="did not move 'rover_zero'"):
        place_in_gazebo("ign", "maze", "rover_zero", TARGET)


@pytest.mark.parametrize(("command", "package"), [("ign", "ignition.msgs"), ("gz", "gz.msgs")])
def test_each_gazebo_command_uses_its_own_message_package(fake_command, command, package):
    arguments = fake_command(name=command)
    Placer(Ros2Settings(reset=command, model="rover"), "moon", Wire()).place(TARGET)
    called_with = arguments.read_text().splitlines()
    assert called_with[:3] == ["service", "-s", "/world/moon/set_pose"]
    assert called_with[3:7] == ["--reqtype", f"{package}.Pose", "--reptype", f"{package}.Boolean"]
    assert called_with[7:10] == ["--timeout", "2000", "--req"]
    assert called_with[10].startswith(
        'name: "rover", position: {x: 1.0, y: -2.0, z: 0.75}, orientation: {x: 0.0, y: 0.0, z: 0.247'
    )


def test_a_hanging_command_times_out(fake_command, monkeypatch):
    monkeypatch.setattr("rover_rl.sims.ros2.poses.SERVICE_TIMEOUT_MS", 100)
    fake_command(extra="exec sleep 60")
    with pytest.raises(PoseResetError, match="did not finish within"):
        place_in_gazebo("ign", "maze", "rover", TARGET)
