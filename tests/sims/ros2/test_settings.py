from __future__ import annotations

import math
from dataclasses import fields, replace
from itertools import product

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rover_rl.envs.sensors.heights import HeightScan
from rover_rl.robots import get_robot
from rover_rl.sims.command_limiter import CommandLimiter, CommandLimits
from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.sims.settings import MIN_REVERSAL, Connection

LIMITS = CommandLimits(speed=1.0, yaw_rate=2.0, acceleration=5.0, yaw_acceleration=4.0)


def limited(limiter, last, wanted, limits=LIMITS, dt=0.05):
    """The command of one rover."""
    values = (torch.tensor([each], dtype=torch.float64) for each in (last, wanted, (dt,), limits))
    return tuple(limiter(*values)[0].tolist())


@given(
    wanted=st.lists(st.tuples(st.floats(-20, 20), st.floats(-20, 20), st.floats(0.01, 0.2)), max_size=30),
    speed=st.floats(0.05, 3.0),
    yaw_rate=st.floats(0.05, 8.0),
)
def test_commands_never_exceed_the_limits(wanted, speed, yaw_rate):
    limits = LIMITS._replace(speed=speed, yaw_rate=yaw_rate)
    limiter, last = CommandLimiter(MIN_REVERSAL), (0.0, 0.0)
    for v, w, dt in wanted:
        sent = limited(limiter, last, (v, w), limits, dt)
        assert abs(sent[0]) <= speed
        assert abs(sent[1]) <= yaw_rate
        assert abs(sent[0] - last[0]) <= limits.acceleration * dt + 1e-9
        assert abs(sent[1] - last[1]) <= limits.yaw_acceleration * dt + 1e-9
        last = sent


def test_a_large_reversal_is_executed_and_a_small_one_stops_turning():
    limiter, small = CommandLimiter(MIN_REVERSAL), MIN_REVERSAL - 0.01
    # The last yaw rate, the wanted one, and the one that is sent.
    for last, wanted, sent in [
        (0.0, 0.2, 0.2),
        (0.2, -small, 0.0),
        (0.0, -small, 0.0),
        (0.0, -MIN_REVERSAL - 0.01, -0.2),
        (-0.2, -0.01, -0.01),  # the same direction
        (0.0, 0.1, 0.0),
    ]:
        assert limited(limiter, (0.0, last), (0.0, wanted))[1] == pytest.approx(sent)
    limiter.reset()
    assert limited(limiter, (0.0, 0.0), (0.0, 0.1))[1] == pytest.approx(0.1)


def test_settings_override_the_limits_of_the_robot():
    robot = get_robot("rover_zero")
    slow = replace(robot, drive=replace(robot.drive, max_speed=0.4))
    assert CommandLimits.of(slow, Ros2Settings()) == CommandLimits(0.4, 7.0, 5.0, 4.0)
    settings = Ros2Settings(max_speed=0.3, max_yaw_rate=0.5, max_acceleration=0.6, max_yaw_acceleration=0.7)
    assert CommandLimits.of(slow, settings) == CommandLimits(0.3, 0.5, 0.6, 0.7)


@pytest.mark.parametrize(
    ("names", "values", "message"),
    [
        (["max_speed", "max_yaw_acceleration"], [0.0, -1.0, math.nan, math.inf], "must be positive and finite"),
        (["step_timeout"], [0.0], "must be positive and finite"),
        (["reset", "transport"], ["later"], "must be one of"),
        (["lidar_yaw"], [math.nan], "must be a finite angle"),
        (["max_invalid"], [1.0], "must be at least 0 and less than 1"),
        (["node"], ["my node", "/rover/", "2rover", ""], "must be letters"),
    ],
)
def test_invalid_settings_are_rejected(names, values, message):
    for name, value in product(names, values):
        with pytest.raises(ValueError, match=f"{name} {message}"):
            Ros2Settings(**{name: value})


@pytest.mark.parametrize("name", ["", "my scan", "/a//b", "/a/1b", "a" * 248, None])
def test_invalid_topics_are_refused_by_the_name_of_their_setting(name):
    topics = [field.name for field in fields(Connection) if field.name.endswith("_topic")]
    described = dict.fromkeys(topics, Connection) | dict.fromkeys(("pose_topic", "reset_topic"), Ros2Settings)
    for setting, kind in described.items() if name is None else [*described.items(), ("topic", HeightScan)]:
        with pytest.raises(ValueError, match=f"{setting} must be a topic of ROS 2, such as /scan"):
            kind(**{setting: name})
    Connection(scan_topic="scan", imu_topic="/robot_1/imu/Data2", points_topic="_c")
