"""Attributes of the original environment, with its names and spelling."""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from typing import Any

from rover_rl.envs.config import RewardConfig
from rover_rl.envs.rover import RoverEnv
from rover_rl.sims.rotations import quaternion_to_euler
from rover_rl.sims.worlds import World


def _env_property(path: str, doc: str) -> property:
    """Returns an attribute of the ``RoverEnv``, named by its dotted path."""
    return property(lambda wrapper: attrgetter(path)(wrapper.base_env), doc=doc)


def _world_property(get: Callable[[World], Any], doc: str) -> property:
    return property(lambda wrapper: get(wrapper.base_env.worlds[0]), doc=doc)


def _reward_property(name: str, doc: str) -> property:
    return property(lambda wrapper: getattr(_reward_config(wrapper), name), doc=doc)


def _state_property(get: Callable[[RoverEnv], Any], doc: str) -> property:
    return property(lambda wrapper: get(wrapper.base_env), doc=doc)


def _euler_property(axis: int, doc: str) -> property:
    return _state_property(lambda env: quaternion_to_euler(env.rover_state.orientation)[0, axis].item(), doc)


class OriginalNames:
    """Read-only attributes of the original environment, for :class:`~rover_rl.envs.wrappers.gym.GymWrapper`."""

    size = _env_property("size", "Size of the camera buffer, pixels. Reserved for vision.")
    length = _env_property("length", "Number of steps after which an episode ends.")
    _length = length
    lidar_points = _env_property("lidar.points", "Number of lidar readings in an observation.")
    max_lidar_range = _env_property("lidar.max_range", "Maximum of a lidar reading, m.")

    world_n = _world_property(lambda world: world.name, "Name of the world.")
    rand_x_range = _world_property(lambda world: world.spawn_range[0], "Range of start positions in x, (low, high), m.")
    rand_y_range = _world_property(lambda world: world.spawn_range[1], "Range of start positions in y, (low, high), m.")
    rand_goal_x_range = _world_property(lambda world: world.goal_range[0], "Range of goals in x, (low, high), m.")
    rand_goal_y_range = _world_property(lambda world: world.goal_range[1], "Range of goals in y, (low, high), m.")
    too_far_away_low_x = _world_property(lambda world: world.bounds[0][0], "Lower bound of the world in x, m.")
    too_far_away_high_x = _world_property(lambda world: world.bounds[0][1], "Upper bound of the world in x, m.")
    too_far_away_low_y = _world_property(lambda world: world.bounds[1][0], "Lower bound of the world in y, m.")
    too_far_away_high_y = _world_property(lambda world: world.bounds[1][1], "Upper bound of the world in y, m.")

    success_distance = _env_property("task.success_distance", "Distance below which a goal is reached, m.")
    collision_threshold = _env_property(
        "task.collision_threshold", "Lidar reading below which the rover is in collision, m."
    )
    collision_window = _env_property(
        "task.collision_window", "Consecutive steps in collision above which the rover is jammed."
    )
    stuck_window = _env_property("task.stuck_window", "Number of recent positions that tell a stuck rover.")
    stuck_threshold = _env_property(
        "task.stuck_threshold", "Displacement over the window below which the rover is stuck, m."
    )

    goal_reward = _reward_property("goal_reward", "Reward for reaching a goal.")
    distance_delta_scale = _reward_property("distance_delta_scale", "Reward per meter of progress toward the goal.")
    final_reward_multiplier = _reward_property(
        "final_reward_multiplier", "Factor of the progress reward and of the idle penalty."
    )
    collision_penalty = _reward_property("collision_penalty", "Reward for each step in collision.")
    stuck_penilty = _reward_property("stuck_penalty", "Reward for an episode that ends with a stuck rover.")
    general_penility = _reward_property("general_penalty", "Reward for an episode that ends in a flip or a jam.")
    too_far_away_penilty = _reward_property("out_of_bounds_penalty", "Reward for leaving the world's bounds.")

    current_roll = _euler_property(0, "Roll, rad.")
    current_pitch = _euler_property(1, "Pitch, rad.")
    current_yaw = _euler_property(2, "Yaw, rad.")
    current_linear_velocity = _state_property(
        lambda env: env.rover_state.linear_velocity.item(), "Forward speed from wheel odometry, m/s."
    )
    current_angular_velocity = _state_property(
        lambda env: env.rover_state.angular_velocity.item(), "Yaw rate from wheel odometry, rad/s."
    )
    rover_position = _state_property(
        lambda env: env.rover_state.position[0].numpy(force=True).copy(), "Position, float32 [3], m."
    )
    lidar_data = property(
        lambda wrapper: wrapper.get_observation()["lidar"], doc="Pooled lidar scan, float32 [lidar_points], m."
    )
    target_positions_x = _state_property(lambda env: env.goal[0, 0].item(), "Position of the goal in x, m.")
    target_positions_y = _state_property(lambda env: env.goal[0, 1].item(), "Position of the goal in y, m.")


def _reward_config(wrapper: Any) -> RewardConfig:
    config: RewardConfig | None = wrapper.reward_config
    if config is None:
        raise AttributeError(
            "the parameters of the contract's reward are only known if this class has added the reward; "
            "pass a bare RoverEnv, with reward='contract' or a RewardConfig"
        )
    return config
