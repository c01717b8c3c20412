"""``rover-rl drive`` and ``rover-rl robot``, on a wire of this process."""

from __future__ import annotations

import math
import signal
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from rover_rl.algos.deploy.recorded_drives import read_drives
from rover_rl.algos.evaluation.episodes import stored_episodes
from rover_rl.cli import main
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.messages import CompressedImage, Image, LaserScan, Twist
from rover_rl.worlds import get_world
from tests.sims.ros2.wire import SimulatedRobot

FAR = ("drive", "scripted", "--world", "maze", "--goal", "9", "9")  # a drive that does not end soon


@pytest.fixture
def robot(wire) -> Iterator[SimulatedRobot]:
    """A robot that stands at a stored start without a wall nearby."""
    robot = SimulatedRobot(wire, get_world("maze"), tuple(stored_episodes("maze").start[0].tolist()))
    yield robot
    robot.rover.close()


@pytest.fixture
def bag(tmp_path) -> list[str]:
    return ["--bag", str(tmp_path / "drive.mcap")]


def endings(bag: list[str]) -> list[str]:
    return [drive.ending for drive in read_drives(Path(bag[1])).drives]


def drives(robot: SimulatedRobot) -> bool:
    return robot.rover.env.rover_state.linear_velocity.item() > 0.1


def test_drive_visits_goals_and_records_them(robot, wire, bag, capsys):
    code = main(["drive", "pretrained:anywhere", "--world", "maze", "--random", "2", "--seconds", "1", *bag])
    assert len(endings(bag)) == 2
    assert code == (endings(bag) != ["goal", "goal"])
    output = capsys.readouterr().out
    assert output.count("goal 1,") == output.count("goal 2,") == 1
    assert f"Bag: {bag[1]}" in output
    assert wire.sent["/cmd_vel"][-2:] == [Twist(), Twist()]


@pytest.mark.parametrize(
    ("number", "suppressed"), [(signal.SIGINT, False), (signal.SIGTERM, False), (signal.SIGINT, True)]
)
def test_a_signal_stops_the_rover_even_if_a_library_suppresses_it(robot, wire, bag, number, suppressed):
    before = signal.getsignal(number)

    def interrupt() -> None:
        if drives(robot):
            with suppress(KeyboardInterrupt if suppressed else ()):
                signal.raise_signal(number)

    wire.rovers.append(interrupt)
    assert main([*FAR, *bag]) == 130
    assert endings(bag) == ["stopped"]
    assert Path(bag[1]).read_bytes().endswith(b"MCAP0\r\n")  # the file is whole
    assert signal.getsignal(number) is before
    assert wire.sent["/cmd_vel"][-2:] == [Twist(), Twist()]


def test_silent_sensors_stop_the_rover(robot, wire, bag, capsys):
    wire.rovers.append(lambda: drives(robot) and wire.rovers.clear())
    assert main([*FAR, *bag]) == 2
    assert "rover-rl: lost the robot: /scan (scan): the last message is" in capsys.readouterr().err
    assert wire.sent["/cmd_vel"][-2:] == [Twist(), Twist()]
    assert endings(bag) == ["stopped"]


def test_a_dry_run_sends_nothing(robot, wire, bag, capsys):
    assert main([*FAR, "--dry-run", "--seconds", "0.5", *bag]) == 1
    output = capsys.readouterr().out
    assert output.count("m/s") == 2 * 10
    assert "goal 1, 9.00 9.00: time limit" in output
    assert not wire.sent["/cmd_vel"]


class Rviz:
    """Sends goals to a drive by its status, and at last Ctrl-C. It stands for the module ``time`` of the goals."""

    def __init__(self, wire, robot) -> None:
        self._wire, self._robot = wire, robot
        self.refused = [(40.0, 0.0, "world"), (9.0, 9.0, "odm"), (math.nan, 0.0, "")]
        self.at_cancel: list[Twist] = []
        wire.rovers.append(self._while_driving)

    @property
    def told(self) -> list[str]:
        return [message.data for message in self._wire.sent["/goal_pose/status"]]

    def send(self, x: float, y: float, frame: str = "") -> None:
        pose = ros.Pose(ros.Point(x, y))
        self._wire.say("/goal_pose", ros.PoseStamped(ros.Header(frame_id=frame), pose), "rviz")

    def sleep(self, _: float) -> None:
        if self.told[-1] == "waiting" or self.told[-1].startswith("refused"):
            self.send(*(self.refused.pop(0) if self.refused else (9.0, 9.0, "map")))
        else:
            self.at_cancel = self._wire.sent["/cmd_vel"][-2:]
            signal.raise_signal(signal.SIGINT)

    def _while_driving(self) -> None:
        if drives(self._robot):
            if self.told[-1] == "driving to 9.00 9.00":
                self.send(9.0, 8.0)
            elif self.told[-1] == "driving to 9.00 8.00":
                self._wire.say("/goal_pose/cancel", ros.Empty(), "rviz")


def test_goals_come_one_by_one_from_a_topic_and_are_refused_replaced_and_canceled(
    robot, wire, bag, capsys, monkeypatch
):
    rviz = Rviz(wire, robot)
    monkeypatch.setattr("rover_rl.algos.deploy.goals.time", rviz)
    assert main(["drive", "scripted", "--world", "maze", "--goal-topic", "/goal_pose", *bag]) == 130
    told = rviz.told
    assert told[0] == "waiting"
    assert told[1].startswith("refused 40.00 0.00: the goal 40 0 is outside of the bounds of maze")
    assert told[2] == "refused 9.00 9.00: no transform leads from 'world' to 'odm'"
    assert told[3] == "refused nan 0.00: it is not finite"
    assert told[4:] == ["driving to 9.00 9.00", "replaced", "driving to 9.00 8.00", "canceled"]
    assert rviz.at_cancel == [Twist(), Twist()]
    output = capsys.readouterr().out
    assert "goal 1, 9.00 9.00: replaced" in output
    assert "goal 2, 9.00 8.00: canceled" in output
    assert endings(bag) == ["stopped", "stopped"]


def test_drive_without_a_robot_reports_an_error(wire, bag, failed):
    told = failed(*FAR, "--timeout", "0.2", *bag)
    assert "rover-rl: lost the robot: /scan (scan): no message has arrived yet" in told


def test_the_robot_publishes_the_cameras_that_are_asked_for_until_a_signal(wire, monkeypatch):
    monkeypatch.setattr("rover_rl.sims.ros2.transport.make_transport", lambda *_: wire)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    wire.subscribe("/scan", LaserScan, lambda scan: signal.raise_signal(signal.SIGTERM))
    cameras = ["--sensors", "colors", "depth", "--camera-topic", "/d/compressedDepth", "--color-topic", "/c/compressed"]
    try:
        assert main(["robot", "--backend", "warp", "--lidar-beams", "16", *cameras]) == 0
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    images = {topic: type(sent[0]) for topic, sent in wire.sent.items() if type(sent[0]) in (Image, CompressedImage)}
    assert images == {"/d/compressedDepth": CompressedImage, "/c/compressed": CompressedImage}
    assert wire.closed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("drive scripted --goal 1 1", "say which --world"),
        ("drive random --world maze --goal 1 1", "cannot drive a live rover"),
        ("drive scripted --world maze", "say where to"),
        ("drive scripted --world maze --goal nan 1", "--goal must be finite numbers, got nan 1"),
        (
            "drive scripted --world maze --goal 1 1 --goal 40 0",
            "the goal 40 0 is outside of the bounds of maze: x from -30 to 30 m, y from -30 to 30 m; name the --world",
        ),
        ("drive scripted --goal 1 1 --clearance -1", "clearance must be at least 0 and at most 1e+30, got -1.0"),
        ("drive scripted --goal 1 1 --timeout nan", "timeout must be at least 0 and at most 1e+06, got nan"),
        ("drive scripted --goal 1 1 --lidar-yaw nan", "lidar_yaw must be a finite angle in rad, got nan"),
        ("drive scripted --world maze --goals goals.csv", "goals.csv must have two numbers a line"),
        ("drive gridplanner --excite", "leave out the policy and the goals"),
        ("drive --excite --goal 1 1", "leave out the policy and the goals"),
        ("drive --goal 1 1", "or drive with --excite"),
        ("drive --excite --radius 0", "radius must be positive"),
        ("dataset drive.mcap --out drives", "must end in -v and a number"),
        ("dataset drive.mcap --out drives-v0", "drives-v0 is there already"),
        ("robot --rate 0", "rate must be positive and at most 1000, got 0"),
        ("robot --lidar-beams 0", "lidar_beams must be at least 1 and at most 16383, got 0"),
        ("robot --lidar-view 0", "lidar_view must be positive and at most 360, got 0"),
    ],
)
def test_invalid_options_are_rejected_before_connecting(arguments, message, failed, tmp_path, monkeypatch):
    for part in ("sims.ros2.commands.Watchdog", "envs.rover.RoverEnv", "sims.ros2.transport.make_transport"):
        monkeypatch.setattr(f"rover_rl.{part}", None)
    monkeypatch.chdir(tmp_path)
    Path("goals.csv").write_text("1.0, 2.0\nx, y\n")
    Path("drives-v0").mkdir()
    assert message in failed(*arguments.split())
