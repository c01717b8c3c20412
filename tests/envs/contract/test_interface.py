"""The interface of the contract: arguments and defaults, observations and actions. ``test_gym.py`` has its spaces."""

from __future__ import annotations

import inspect
import math
from dataclasses import asdict

import hypothesis
import pytest
import torch
from hypothesis import strategies as st
from torchrl.envs import EnvBase

from rover_rl import RewardConfig, RoverEnv
from rover_rl.envs.config import HeadingGains
from rover_rl.envs.sensors.standard import LidarPooling
from rover_rl.envs.stages import HeadingController
from rover_rl.envs.task import target_info
from tests.envs import transcription as contract
from tests.envs.scripted import FAR_GOAL, Moment, assert_same_angle, bare, pairs, play, scripted

ARGUMENTS = {"size": (64, 64), "length": 2000, "scan_topic": "/scan", "imu_topic": "/imu/data"}
ARGUMENTS |= {"cmd_vel_topic": "/cmd_vel", "camera_topic": "/camera/image_raw", "world_n": "inspect"}
ARGUMENTS |= {"connection_check_timeout": 30, "lidar_points": 32, "max_lidar_range": 12.0}
TASK = {"success_distance": 0.5, "min_goal_distance": 1.0, "collision_threshold": 0.3, "collision_window": 15}
TASK |= {"flip_threshold": 1.48, "stuck_window": 600, "stuck_threshold": 0.001, "collision_from": "lidar"}
REWARD = {"goal_reward": 100.0, "distance_delta_scale": 0.3, "final_reward_multiplier": 1.5, "idle_penalty": -0.03}
REWARD |= {"min_progress": 0.001, "min_alignment": 0.0, "velocity_scale": 0.0025, "turn_scale": -0.0015}
REWARD |= {"collision_penalty": -0.5, "stuck_penalty": -25.0, "general_penalty": -20.0, "flip_grace_steps": 500}
REWARD |= {"out_of_bounds_penalty": -10.0}


def test_the_constructor_takes_the_contracts_ten_arguments_in_order_and_further_settings_by_name():
    parameters = inspect.signature(RoverEnv).parameters.values()
    positional = [(p.name, p.default) for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
    assert positional == [*ARGUMENTS.items()]
    keywords = {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}
    expected = {"num_envs": 1, "backend": "bullet", "robot": "rover_zero", "lidar_beams": 128, "seed": None}
    assert (expected | {"device": None, "end_on_goal": False}).items() <= keywords.items()


def test_thresholds_rewards_and_gains_are_the_contracts():
    assert asdict(RoverEnv(backend="warp").config.task) == TASK
    reward = asdict(RewardConfig())
    assert REWARD.items() <= reward.items()
    # Penalties that the contract does not have are off.
    others = {name: value for name, value in reward.items() if name not in REWARD and name.endswith("penalty")}
    assert len(others) == 7
    assert not any(others.values())
    assert asdict(HeadingGains()) == {"kp": 2.0, "ki": 0.0, "kd": 0.1, "max_output": 7.0}


# Observations


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


# Actions


def commands(env: EnvBase, actions: list[tuple[float, float]]) -> list[list[float]]:
    """Resets, then returns the twist commanded to row 0 for each action."""
    td = env.reset(goal=pairs(FAR_GOAL))
    sent = []
    for action in actions:
        td["action"] = pairs(action)
        td = env.step(td)["next"]
        sent.append(bare(env).simulator.commands[-1][0].tolist())
    return sent


def test_finite_actions_outside_of_their_bounds_are_clipped():
    inside, outside = ([(1.0, math.pi), (-1.0, 0.1)], [(5.0, 9.0), (-3.0, 0.1)])
    assert commands(scripted([Moment()]), outside) == commands(scripted([Moment()]), inside)


# Kept off the wrap at pi, where rounding could flip the sign of the error.
offsets = st.floats(-3.125, 3.125, width=32)
yaws = st.floats(-3.140625, 3.140625, width=32)


@hypothesis.settings(max_examples=60, deadline=None)
@hypothesis.given(
    headings=st.lists(st.tuples(offsets, yaws), min_size=1, max_size=8),
    ki=st.sampled_from([0.0, 0.5]),
    dt=st.sampled_from([0.05, 0.1]),
)
def test_the_heading_controller_is_the_contracts_pid(headings, ki, dt):
    controller = HeadingController(1, HeadingGains(ki=ki))
    pid = contract.HeadingPid(ki=ki)
    for offset, yaw in headings:
        desired, current = torch.tensor([[yaw + offset]]), torch.tensor([[yaw]])
        rate = controller(desired, current, torch.tensor([[dt]])).item()
        assert rate == pytest.approx(pid(yaw + offset, yaw, dt), abs=1e-4)


def test_rows_that_are_not_active_keep_their_controller():
    controller, column = HeadingController(2), torch.ones(2, 1)
    controller(0.2 * column, 0 * column, 0.05 * column)
    controller(0.5 * column, 0 * column, 0.05 * column, torch.tensor([[True], [False]]))
    rates = controller(0.5 * column, 0 * column, 0.05 * column).flatten().tolist()
    assert rates == pytest.approx([1.0, 1.0 + 0.1 * 0.3 / 0.05], abs=1e-5)
