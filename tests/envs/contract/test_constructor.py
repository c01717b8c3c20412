"""Constructor: arguments, default values, and settings out of range."""

from __future__ import annotations

import inspect
from dataclasses import asdict

from rover_rl import RewardConfig, RoverEnv
from rover_rl.envs.config import HeadingGains


def test_the_constructor_takes_the_contracts_ten_arguments_in_order_with_their_defaults():
    parameters = inspect.signature(RoverEnv).parameters.values()
    positional = [(p.name, p.default) for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
    assert positional == [
        ("size", (64, 64)),
        ("length", 2000),
        ("scan_topic", "/scan"),
        ("imu_topic", "/imu/data"),
        ("cmd_vel_topic", "/cmd_vel"),
        ("camera_topic", "/camera/image_raw"),
        ("world_n", "inspect"),
        ("connection_check_timeout", 30),
        ("lidar_points", 32),
        ("max_lidar_range", 12.0),
    ]


def test_further_settings_are_keyword_only_with_the_defaults_of_the_design():
    parameters = inspect.signature(RoverEnv).parameters.values()
    keywords = {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}
    expected = {
        "num_envs": 1,
        "backend": "bullet",
        "robot": "rover_zero",
        "lidar_beams": 128,
        "seed": None,
        "device": None,
        "end_on_goal": False,
    }
    assert expected.items() <= keywords.items()


def test_the_task_has_the_contracts_thresholds():
    assert asdict(RoverEnv(backend="warp").config.task) == {
        "success_distance": 0.5,
        "min_goal_distance": 1.0,
        "collision_threshold": 0.3,
        "collision_window": 15,
        "flip_threshold": 1.48,
        "stuck_window": 600,
        "stuck_threshold": 0.001,
        "collision_from": "lidar",
    }


def test_the_reward_has_the_contracts_numbers():
    assert asdict(RewardConfig()) == {
        "goal_reward": 100.0,
        "distance_delta_scale": 0.3,
        "final_reward_multiplier": 1.5,
        "idle_penalty": -0.03,
        "min_progress": 0.001,
        "min_alignment": 0.0,
        "velocity_scale": 0.0025,
        "turn_scale": -0.0015,
        "collision_penalty": -0.5,
        "stuck_penalty": -25.0,
        "general_penalty": -20.0,
        "flip_grace_steps": 500,
        "out_of_bounds_penalty": -10.0,
        # Components that the contract does not have are off.
        "clearance_penalty": 0.0,
        "clearance_distance": 0.5,
        "action_rate_penalty": 0.0,
        "mover_contact_penalty": 0.0,
        "struck_penalty": 0.0,
        "intrusion_penalty": 0.0,
        "haste_penalty": 0.0,
        "risk_penalty": 0.0,
        "intrusion_distance": 1.2,
        "risk_distance": 0.5,
    }


def test_the_heading_pid_has_the_contracts_gains():
    assert asdict(HeadingGains()) == {"kp": 2.0, "ki": 0.0, "kd": 0.1, "max_output": 7.0}
