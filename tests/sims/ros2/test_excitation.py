"""The drive that tells the numbers of a robot: it finds those of a hidden one, stays around its start, and stops."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from rover_rl import Terrain, World, box
from rover_rl.algos.calibration.calibrate import calibrate
from rover_rl.algos.calibration.reading import read_recording
from rover_rl.algos.deploy import bags
from rover_rl.algos.deploy.excitation import parts_of
from rover_rl.algos.deploy.recorded_drives import read_drives
from rover_rl.cli.main import main
from rover_rl.cli.train import INTERRUPTED
from rover_rl.envs.config import LimitsConfig, Randomization
from rover_rl.robots import get_robot
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.settings import Connection
from tests.sims.ros2.wire import SimulatedRobot, Wire

OPEN = World("open", Terrain.flat((30, 30)), obstacles=[box((-6, 3, 0.5), (1, 8, 1)), box((7, -2, 0.5), (1, 5, 1))])
RADIUS = 1.5


@pytest.fixture(autouse=True)
def _recorded_in_time_of_the_wire(wire: Wire, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bags, "time", SimpleNamespace(time_ns=lambda: round(1e9 * wire.now)))
    monkeypatch.setattr(bags, "WAITING", 10**6)


def excite(bag: Path, *options: str) -> int:
    return main(["drive", "--excite", "--radius", str(RADIUS), "--bag", str(bag), *options])


@pytest.mark.slow
def test_it_tells_the_numbers_of_a_hidden_robot_and_stays_around_its_start(wire, tmp_path, capsys):
    hidden = LimitsConfig(max_speed=0.7, max_acceleration=0.9, max_yaw_rate=1.8, max_yaw_acceleration=2.5)
    late = Randomization(latency=(2, 2), odometry_noise=0.02)
    robot = SimulatedRobot(wire, OPEN, (0.5, 0.3, 1.0), limits=hidden, randomization=late)
    assert excite(tmp_path / "drive.mcap") == 0
    assert "excite: complete" in capsys.readouterr().out
    assert wire.sent["/cmd_vel"][-3:] == [ros.Twist()] * 3
    places = torch.stack([place[:2] for place, _ in robot.poses.values()])
    assert (places - torch.tensor([0.5, 0.3])).norm(dim=-1).max() < RADIUS + 0.1
    recording = read_recording(tmp_path / "drive.mcap", Connection(), Ros2Settings())
    numbers = calibrate(recording, get_robot("rover_zero")).numbers
    assert {name for name, number in numbers.items() if number.estimate is None} <= {"friction"} | {
        f"{name}_age"
        for name in ("odometry", "imu", "pose", "scan")  # their stamps are of another clock here
    }
    for name, value in {
        "speed_top": 0.7,
        "turn_top": 1.8,
        "speed_acceleration": 0.9,
        "turn_acceleration": 2.5,
        "odometry_noise": 0.02,
    }.items():
        assert numbers[name].estimate.value == pytest.approx(value, rel=0.1), name
    assert numbers["command_delay"].estimate.value == pytest.approx(0.1, abs=0.03)
    robot.rover.close()


def near(scan: ros.LaserScan) -> ros.LaserScan:
    ranges = scan.ranges.copy()
    ranges[0] = 0.4
    return replace(scan, ranges=ranges)


def interrupt(scan: ros.LaserScan) -> ros.LaserScan:
    signal.raise_signal(signal.SIGINT)
    return scan


@pytest.mark.parametrize(
    ("event", "code", "ending"), [(near, 1, "obstacle too near"), (interrupt, INTERRUPTED, "stopped")]
)
def test_it_stops_at_what_is_too_near_and_when_it_is_interrupted(wire, tmp_path, event, code, ending):
    robot = SimulatedRobot(wire, OPEN, (0.0, 0.0, 0.0))
    wire.tamper["/scan"] = lambda scan: event(scan) if max(robot.driven, default=0.0) > 0.1 else scan
    assert excite(tmp_path / "drive.mcap") == code
    assert wire.sent["/cmd_vel"][-3:] == [ros.Twist()] * 3
    assert [drive.ending for drive in read_drives(tmp_path / "drive.mcap").drives] == [ending]
    robot.rover.close()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["gridplanner", "--excite"], "leave out the policy and the goals"),
        (["--excite", "--goal", "1", "1"], "leave out the policy and the goals"),
        (["--goal", "1", "1"], "or drive with --excite"),
        (["--excite", "--radius", "0"], "radius must be"),
    ],
)
def test_wrong_options_are_told(options, told, capsys):
    assert main(["drive", *options]) == 2
    assert told in capsys.readouterr().err


def test_a_robot_that_does_not_turn_in_place_drives_bows():
    for turns_in_place in (False, True):
        parts = parts_of(1.0, 1.0, 2.0, turns_in_place)
        assert any(part.turn and not part.speed for part in parts) == turns_in_place
