from __future__ import annotations

import stat
from pathlib import Path

import pytest

from rover_rl.sims.ros2.pose_reset import GazeboPlacer, PoseResetError, Target, succeeded

TARGET = Target(1.0, -2.0, 0.75, 0.5)

OUTPUTS = {
    # What the command prints, and where; its exit code is 0 for all of them.
    "success": ("data: true\n\n", "", True),
    "refused": ("\n", "", False),
    "refused in words": ("data: false\n", "", False),
    "no answer": ("Service call timed out\n", "", False),
    "failure": ("Service call failed\n", "", False),
    "bad type": ("", "Unable to create request of type[ignition.msgs.Pose].\n", False),
    "malformed request": ("data: true\n", "[libprotobuf ERROR google/protobuf] Error parsing text-format\n", False),
    "malformed request, all in one": ("[libprotobuf ERROR x] Error parsing\ndata: true\n", "", False),
    "nothing": ("", "", False),
    "true elsewhere": ("metadata: trueish\n", "", False),
}


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Puts an executable called ``ign`` first on the PATH, which keeps its arguments and says what it is told to."""

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


@pytest.mark.parametrize("said", OUTPUTS.values(), ids=OUTPUTS.keys())
def test_only_the_true_success_counts(stand_in, said):
    output, errors, works = said
    stand_in(output, errors)
    placer = GazeboPlacer("ign", "maze", "rover_zero")
    if works:
        placer.place(TARGET)
    else:
        with pytest.raises(PoseResetError, match="did not put 'rover_zero' back"):
            placer.place(TARGET)
    assert succeeded(output, errors) is works


@pytest.mark.parametrize(("command", "package"), [("ign", "ignition.msgs"), ("gz", "gz.msgs")])
def test_each_gazebo_is_asked_in_its_own_words(stand_in, command, package):
    arguments = stand_in(name=command)
    GazeboPlacer(command, "moon", "rover").place(TARGET)
    told = arguments.read_text().splitlines()
    assert told[:3] == ["service", "-s", "/world/moon/set_pose"]
    assert told[3:7] == ["--reqtype", f"{package}.Pose", "--reptype", f"{package}.Boolean"]
    assert told[7:10] == ["--timeout", "2000", "--req"]
    assert told[10].startswith(
        'name: "rover", position: {x: 1.0, y: -2.0, z: 0.75}, orientation: {x: 0.0, y: 0.0, z: 0.247'
    )


def test_numbers_that_are_none_are_not_sent(stand_in):
    arguments = stand_in()
    with pytest.raises(PoseResetError, match="finite numbers"):
        GazeboPlacer("ign", "maze", "rover").place(Target(float("nan"), 0.0, 0.0, 0.0))
    assert not arguments.exists()


def test_a_command_that_hangs_is_given_up(stand_in, monkeypatch):
    monkeypatch.setattr("rover_rl.sims.ros2.pose_reset._ANSWER_MS", 100)
    stand_in(extra="exec sleep 60")
    with pytest.raises(PoseResetError, match="did not come back"):
        GazeboPlacer("ign", "maze", "rover").place(TARGET)


def test_a_command_that_is_missing_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FileNotFoundError, match="needs Gazebo's command 'gz'"):
        GazeboPlacer("gz", "maze", "rover")
