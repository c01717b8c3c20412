"""Observation: bounds and content of each key, lidar pooling and target."""

from __future__ import annotations

import math

import hypothesis
import pytest
import torch
from hypothesis import strategies as st

from rover_rl.envs.sensors.standard import LidarPooling
from rover_rl.envs.task import target_info
from tests.envs import transcription as contract
from tests.envs.contract.scripted_env import assert_same_angle, play, scripted
from tests.envs.scripted import Moment

SPACE = {
    "lidar": ([0.0] * 32, [12.0] * 32),
    "pose": ([-30.0, -30.0, -10.0], [30.0, 30.0, 10.0]),
    "imu": ([-math.pi] * 3, [math.pi] * 3),
    "target": ([0.0, -math.pi], [100.0, math.pi]),
    "velocities": ([-10.0, -10.0], [10.0, 10.0]),
}


@pytest.mark.parametrize("key", SPACE)
def test_observation_bounds_shape_and_dtype_are_the_contracts(key):
    low, high = SPACE[key]
    spec = scripted([Moment()], [Moment()]).observation_spec[key]
    assert spec.shape == (2, len(low))
    assert spec.dtype == torch.float32
    for row in range(2):
        assert spec.space.low[row].tolist() == torch.tensor(low).tolist()
        assert spec.space.high[row].tolist() == torch.tensor(high).tolist()


def test_lidar_points_and_max_lidar_range_shape_the_lidar_space():
    env = scripted([Moment(ranges=7.0)], lidar_points=8, max_lidar_range=6.0)
    assert env.observation_spec["lidar"].shape == (1, 8)
    assert env.observation_spec["lidar"].space.high.unique().tolist() == [6.0]
    assert env.reset()["lidar"].tolist() == [[6.0] * 8]


def test_the_observation_is_clipped_to_its_bounds_and_the_outcome_is_not():
    env = scripted([Moment(x=-31.0, y=150.0, z=11.0, v=12.0, w=-13.0, ranges=30.0)] * 2)
    result = play(env, 1, goal=(0.0, 0.0))[0]
    assert result["pose"][0].tolist() == [-30.0, 30.0, 10.0]
    assert result["velocities"][0].tolist() == [10.0, -10.0]
    assert result["target"][0, 0] == 100.0
    assert result["lidar"].unique().tolist() == [12.0]
    assert result["outcome", "linear_velocity"].item() == 12.0
    assert result["outcome", "angular_velocity"].item() == -13.0


@hypothesis.settings(max_examples=50, deadline=None)
@hypothesis.given(data=st.data(), points=st.integers(1, 40), extra=st.integers(0, 60))
def test_pooling_is_the_contracts_for_any_beams_and_any_readings(data, points, extra):
    reading = st.one_of(st.floats(-1, 15, width=32), st.sampled_from([math.inf, -math.inf, math.nan, 0.0, 12.0, -0.0]))
    scan = data.draw(st.lists(reading, min_size=points + extra, max_size=points + extra))
    pooled = LidarPooling(points + extra, points, 12.0)(torch.tensor([scan]))[0].tolist()
    assert pooled == pytest.approx(contract.pool(scan, points), abs=0)


yaws = st.floats(-3.140625, 3.140625, width=32)
coordinates = st.floats(-40, 40, width=32)


@hypothesis.settings(max_examples=50, deadline=None)
@hypothesis.given(coordinates, coordinates, yaws, coordinates, coordinates)
def test_target_info_is_the_contracts(x, y, yaw, goal_x, goal_y):
    distance, angle = contract.target_info(x, y, yaw, (goal_x, goal_y))
    hypothesis.assume(distance > 0.1)
    result = target_info(torch.tensor([[x, y]]), torch.tensor([[yaw]]), torch.tensor([[goal_x, goal_y]]))[0].tolist()
    assert result[0] == pytest.approx(distance, abs=1e-4)
    assert_same_angle(result[1], angle, 1e-4)
