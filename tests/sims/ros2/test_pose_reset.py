from __future__ import annotations

import stat
from pathlib import Path

import pytest

from rover_rl.sims.ros2 import PoseResetError, Ros2Settings
from rover_rl.sims.ros2.pose_reset import Placer, TargetPose, place_in_gazebo
from tests.sims.ros2.wire import Wire

TARGET = TargetPose(1.0, -2.0, 0.75, 0.5)

OUTPUTS = {
    # Standard output, standard error, and whether the call succeeded. The exit code is 0 for all of them.
    "success": ("data: true\n\n", "", True),
    "rejected": ("\n", "", False),
    "rejected with false": ("data: false\n", "", False),
    "no answer": ("Service call timed out\n", "", False),
    "failure": ("Service call failed\n", "", False),
    "bad type": ("", "Unable to create request of type[ignition.msgs.Pose].\n", False),
    "malformed request": ("data: true\n", "[libprotobuf ERROR google/protobuf] Error parsing text-format\n", False),
    "malformed request, all on standard output": ("[libprotobuf ERROR x] Error parsing\ndata: true\n", "", False),
    "nothing": ("", "", False),
    "true elsewhere": ("metadata: trueish\n", "", False),
}


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
        program.chmod(program.stat().st_mode | stat.S_IEXEC)
        monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
        return tmp_path / "arguments"

    return make


@pytest.mark.parametrize("outcome", OUTPUTS.values(), ids=OUTPUTS.keys())
def test_only_a_successful_service_call_is_accepted(fake_command, outcome):
    output, errors, succeeds = outcome
    fake_command(output, errors)
    if succeeds:
        place_in_gazebo("ign", "maze", "rover_zero", TARGET)
    else:
        with pytest.raises(PoseResetError, match="did not move 'rover_zero'"):
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


def test_a_target_that_is_not_finite_is_rejected(fake_command):
    arguments = fake_command()
    with pytest.raises(PoseResetError, match="finite numbers"):
        place_in_gazebo("ign", "maze", "rover", TargetPose(float("nan"), 0.0, 0.0, 0.0))
    assert not arguments.exists()


def test_a_hanging_command_times_out(fake_command, monkeypatch):
    monkeypatch.setattr("rover_rl.sims.ros2.pose_reset._SERVICE_TIMEOUT_MS", 100)
    fake_command(extra="exec sleep 60")
    with pytest.raises(PoseResetError, match="did not finish within"):
        place_in_gazebo("ign", "maze", "rover", TARGET)


def test_a_missing_command_is_reported(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FileNotFoundError, match="needs Gazebo's command 'gz'"):
        Placer(Ros2Settings(reset="gz"), "maze", Wire())
