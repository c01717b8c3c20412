"""Calibration finds the numbers of robots whose numbers are known, and tells which numbers a drive does not tell."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("rosbags")

from rover_rl.algos.calibration.calibrate import Calibration, calibrate
from rover_rl.algos.calibration.reading import read_recording
from rover_rl.algos.config_files import read_config
from rover_rl.cli.main import main
from rover_rl.cli.options import read_env
from rover_rl.envs.config import EnvConfig, LimitsConfig
from rover_rl.envs.served_rover import ServedRover
from rover_rl.files import MADE
from rover_rl.robots import get_robot
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.settings import Connection
from tests.algos.calibration.drives import Truth, drive, exciting, held, write

TOPICS = Connection(), Ros2Settings()
STRAIGHT = held([(0, 0, 14), *[(0.5, 0, 2), (0, 0, 1.5), (-0.5, 0, 2), (0, 0, 1.5)] * 3])
JITTER = 0.0024  # mean jitter of the arrivals of a recording, s


@pytest.fixture(autouse=True)
def _one_thread() -> Any:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def calibrated(folder: Path, truth: Truth, commands: np.ndarray, without: tuple[str, ...] = ()) -> Calibration:
    bag = write(folder, drive(truth, commands), without)
    return calibrate(read_recording(bag, *TOPICS), get_robot("rover_zero"))


def truths(truth: Truth) -> dict[str, float]:
    """Numbers of a robot by the names of the calibration."""
    names = "acceleration", "deceleration"
    found = {f"speed_{name}": getattr(truth, name) for name in names}
    found |= {f"turn_{name}": getattr(truth, f"turn_{name}") for name in names}
    found |= {f"{name}_gain": truth.wheel_scale for name in ("speed", "turn")}
    found |= {f"{name}_lag": getattr(truth, f"{name}_lag") for name in ("speed", "turn")}
    sensors = dict(zip(("odometry", "imu", "pose", "scan"), zip(truth.ages, truth.skews, strict=True), strict=True))
    found |= {f"{name}_age": age - skew + JITTER for name, (age, skew) in sensors.items()}
    found |= {f"{name}_late": skew for name, (_, skew) in sensors.items() if name != "odometry"}
    slip = 1 / (truth.yaw_ratio * truth.wheel_scale)
    return found | {
        "command_delay": truth.command_delay,
        "speed_top": truth.max_speed,
        "turn_top": truth.max_yaw_rate,
        "wheel_scale": truth.wheel_scale,
        "yaw_ratio": truth.yaw_ratio,
        "slip": slip,
        "track": 0.24 * slip,
        "yaw_bias": truth.yaw_bias,
        "friction": truth.friction,
        "odometry_noise": truth.odometry_noise,
        "imu_noise": truth.imu_noise,
        "range_noise": truth.range_noise,
        "lost_beams": 0.02,
    }


@pytest.mark.parametrize(
    ("truth", "seed"),
    [
        (Truth(skews=(0.0, 0.02, -0.03, 0.05), yaw_bias=0.003, friction=0.12), 1),
        (Truth(command_delay=0.21, speed_lag=0.08, wheel_scale=0.97, yaw_ratio=0.6, order="lag first"), 2),
    ],
)
def test_numbers_of_a_kinematic_robot(tmp_path: Path, truth: Truth, seed: int) -> None:
    found, true = calibrated(tmp_path / "bag", truth, exciting(seed, 90.0)), truths(truth)
    told = {name: number.estimate for name, number in found.numbers.items() if number.estimate is not None}
    for name, estimate in told.items():
        error = abs(estimate.value - true[name])
        if name.endswith(("_age", "_late", "_delay")):
            assert error < 0.02, name
        elif name.endswith(("_lag", "_noise")) or name == "friction":
            assert error < 0.15 * true[name] + 0.001, name
        elif name != "yaw_bias":
            assert error < 0.05 * true[name] + 0.002, name
    held_by = [estimate.low <= true[name] <= estimate.high for name, estimate in told.items()]
    assert sum(held_by) >= 0.9 * len(told)
    slipped = math.isfinite(truth.friction)
    assert set(found.numbers) - set(told) == ({"imu_late", "scan_late"} if slipped else {"friction"})
    assert found.errors[0, 2] > 3 * found.errors[1, 2]


def test_sliding_in_arcs_tells_the_friction(tmp_path: Path) -> None:
    # With the wheels of Rover Zero, whose body turns at 0.4 of what they tell, it slides by 1.3 m with this friction.
    friction = 0.361
    truth = Truth(yaw_ratio=0.4 / 1.04, slide=1.3, pose_noise=0.01)
    told = calibrated(tmp_path / "bag", truth, exciting(3)).numbers["friction"].estimate
    assert told is not None
    assert told.value == pytest.approx(friction, rel=0.05)
    assert told.low < friction < told.high


def test_what_a_drive_does_not_tell_is_unknown_and_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write(tmp_path / "bag", drive(Truth(), STRAIGHT), ["/rover/pose_array"])
    out = tmp_path / "out"
    assert main(["calibrate", str(bag), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    _, untold = printed.split("not told by this drive")
    for sentence in (
        "effective track: record a pose",
        "largest speed: command a larger speed",
        "lag of the yaw rate: turn in place for 10 s both ways",
        "delay of pose, from stamp to arrival: record its topic",
        "friction:",
    ):
        assert sentence in untold
    assert "while the robot stands, its measured place goes by 0.0 / 0.0 / 0.0 cm" in printed
    for name in ("delay of commands", "lag of the speed", "bias of the yaw rate", "noise of a range"):
        assert name not in untold
    env = read_env(out / "calibration.yaml")
    training = read_config(out / "calibration.yaml").env
    assert (training.limits, training.randomization) == (env.limits, env.randomization)
    assert env.robot == "rover_zero"
    assert env.limits.apply
    assert env.limits.max_acceleration == pytest.approx(1.2, rel=0.05)
    assert env.limits.max_speed is None
    assert env.limits.max_yaw_acceleration is None
    low, high = env.randomization.latency
    assert low <= (0.12 + 0.15) / 0.05 - 0.5 <= high
    assert env.randomization.odometry_scale == (1.0, 1.0)
    assert MADE.encode() in (out / "calibration.png").read_bytes()


def test_a_robot_at_rest_tells_noise_alone(tmp_path: Path) -> None:
    found = calibrated(tmp_path / "bag", Truth(pose_noise=0.1), held([(0.0, 0.0, 40.0)]))
    numbers = found.numbers
    told = {name for name, number in numbers.items() if number.estimate is not None}
    ages = {f"{name}_age" for name in ("odometry", "imu", "pose", "scan")}
    assert told == {*ages, "imu_noise", "range_noise", "lost_beams", "yaw_bias"}
    assert all(number.advice for number in numbers.values())
    # The difference of two places with errors of 10 cm along each axis, of Rayleigh's distribution.
    assert found.restless == pytest.approx([0.1 * 2**0.5 * 1.177] * 3, rel=0.15)


def dead_reckoned(wheels: list[tuple[float, float, Any]]) -> list[tuple[float, float, Any]]:
    """Poses that add up the velocities of odometry, from another place and in another direction."""
    x, y, yaw, before, poses = 3.0, -2.0, 1.0, wheels[0][1], []
    for arrival, stamp, message in wheels:
        twist, dt, before = message.twist.twist, stamp - before, stamp
        yaw += dt * twist.angular.z
        x, y = x + dt * twist.linear.x * math.cos(yaw), y + dt * twist.linear.x * math.sin(yaw)
        pose = ros.Pose(ros.Point(x, y), ros.Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2)))
        poses.append((arrival, stamp, ros.PoseArray(message.header, [pose])))
    return poses


@pytest.mark.parametrize("is_computed", [True, False])
def test_a_pose_that_is_computed_from_the_wheels_tells_nothing_of_them(tmp_path: Path, is_computed: bool) -> None:
    said = drive(Truth(wheel_scale=1.0, yaw_ratio=1.0), exciting(4, 50.0))
    if is_computed:
        said["/rover/pose_array"] = dead_reckoned(said["/odometry/wheels"])
    recording = read_recording(write(tmp_path / "bag", said, ["/imu/data"]), *TOPICS)
    numbers = calibrate(recording, get_robot("rover_zero")).numbers
    for name in ("wheel_scale", "yaw_ratio"):
        assert (numbers[name].estimate is None) == is_computed, name
    for name in ("wheel_scale", "yaw_ratio", "slip", "track", "friction"):
        assert numbers[name].advice.startswith("the pose repeats the odometry") == is_computed
        assert numbers[name].estimate is None or not is_computed
    assert numbers["pose_late"].estimate is not None


def test_the_simulated_robot_keeps_the_limits_of_the_settings() -> None:
    limits = LimitsConfig(apply=True, max_speed=0.3, max_acceleration=1.0)
    rover = ServedRover(EnvConfig(world="maze", backend="warp", limits=limits, seed=0))
    rover.reset((0.0, 0.0, 0.0))
    speeds = [rover.step((1.0, 0.0)).state.linear_velocity.item() for _ in range(10)]
    rover.close()
    assert speeds[1] < 0.11
    assert max(speeds) == pytest.approx(0.3, abs=0.01)


# Recordings that cannot be used


SHORT = drive(Truth(), held([(0.0, 0.0, 1.0), (0.4, 0.0, 23.0)]))


def refused(folder: Path, said: dict[str, Any], *without: str) -> str:
    with pytest.raises(ValueError) as error:
        read_recording(write(folder, said, without), *TOPICS)
    return str(error.value)


def test_recordings_without_commands_or_odometry_are_refused(tmp_path: Path) -> None:
    told = refused(tmp_path / "bag", SHORT, "/cmd_vel")
    assert "no commands on /cmd_vel: name the topic with --cmd-vel-topic" in told
    assert "/odometry/wheels (nav_msgs/Odometry)" in told
    assert "no odometry on /odometry/wheels" in refused(tmp_path / "other", SHORT, "/odometry/wheels")


def test_other_types_are_refused(tmp_path: Path) -> None:
    said = {**SHORT, "/imu/data": [(t, t, ros.String("none")) for t in (1.0, 2.0)]}
    assert "has std_msgs/String, and --imu-topic takes sensor_msgs/Imu; it has /cmd_vel" in refused(
        tmp_path / "bag", said
    )


def test_two_robots_on_a_topic_are_refused(tmp_path: Path) -> None:
    rows = [
        (t, s, replace(message, header=replace(message.header, frame_id="other/odom")) if index % 2 else message)
        for index, (t, s, message) in enumerate(SHORT["/odometry/wheels"])
    ]
    told = refused(tmp_path / "bag", {**SHORT, "/odometry/wheels": rows})
    assert "several robots or sensors" in told
    assert "'other/odom base_link'" in told


def test_time_that_goes_backward_is_refused(tmp_path: Path) -> None:
    rows = [
        (t, s, replace(message, header=replace(message.header, stamp=ros.Time.from_seconds(1000.0 + s % 10))))
        for t, s, message in SHORT["/imu/data"]
    ]
    told = refused(tmp_path / "bag", {**SHORT, "/imu/data": rows})
    assert "time goes backward on /imu/data" in told


def test_a_short_drive_and_other_files_are_refused(tmp_path: Path) -> None:
    told = refused(tmp_path / "bag", drive(Truth(), held([(0.4, 0.0, 8.0)])))
    assert "and 20 s are the least" in told
    other = tmp_path / "drive.mcap"
    other.write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"drive\.mcap cannot be read: it is no MCAP file"):
        read_recording(other, *TOPICS)
    with pytest.raises(FileNotFoundError):
        read_recording(tmp_path / "nothing", *TOPICS)


# What may be recorded


def test_stamped_commands_and_other_poses_are_read(tmp_path: Path) -> None:
    commands = [(t, s, ros.TwistStamped(twist=message)) for t, s, message in SHORT["/cmd_vel"]]
    for number, pose_of in enumerate(
        (
            lambda header, pose: ros.PoseStamped(header, pose),
            lambda header, pose: ros.PoseWithCovarianceStamped(header, ros.PoseWithCovariance(pose)),
            lambda header, pose: ros.Odometry(header, pose=ros.PoseWithCovariance(pose)),
        )
    ):
        poses = [(t, s, pose_of(message.header, message.poses[0])) for t, s, message in SHORT["/rover/pose_array"]]
        said = {**SHORT, "/cmd_vel": commands, "/rover/pose_array": poses}
        read = read_recording(write(tmp_path / str(number), said), *TOPICS)
        expected = read_recording(write(tmp_path / f"{number}-array", SHORT), *TOPICS)
        assert read.pose is not None
        assert expected.pose is not None
        np.testing.assert_allclose(read.pose.values, expected.pose.values)
        np.testing.assert_allclose(read.commands.values, expected.commands.values)


def test_stamps_of_another_clock_leave_delays_unknown(tmp_path: Path) -> None:
    rows = [
        (t, s, replace(message, header=replace(message.header, stamp=ros.Time.from_seconds(s))))
        for t, s, message in SHORT["/odometry/wheels"]
    ]
    read = read_recording(write(tmp_path / "bag", {**SHORT, "/odometry/wheels": rows}), *TOPICS)
    assert read.odometry.age is None
    assert (read.odometry.stamp == read.odometry.arrival).all()
