"""Constructor: arguments and default values."""

from __future__ import annotations

import inspect
from dataclasses import asdict

from rover_rl import RewardConfig, RoverEnv
from rover_rl.envs.config import HeadingGains

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
