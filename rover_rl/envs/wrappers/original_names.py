"""The original's attributes, under its names and in its spelling."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rover_rl.sims.rotations import quaternion_to_euler

if TYPE_CHECKING:
    from rover_rl.envs.rewards import RewardConfig
    from rover_rl.envs.task import TaskConfig
    from rover_rl.envs.wrappers.gym import GymWrapper
    from rover_rl.sims.worlds import World


def _reads(get: Callable[[GymWrapper], Any], doc: str) -> property:
    return property(get, doc=doc)


def _world(get: Callable[[World], Any], doc: str) -> property:
    return property(lambda env: get(env.base_env.worlds[0]), doc=doc)


def _task(get: Callable[[TaskConfig], Any], doc: str) -> property:
    return property(lambda env: get(env.base_env.task), doc=doc)


def _reward(get: Callable[[RewardConfig], Any], doc: str) -> property:
    return property(lambda env: get(_reward_config(env)), doc=doc)


def _euler(axis: int, doc: str) -> property:
    return property(lambda env: quaternion_to_euler(env.base_env.sensed_state.orientation)[0, axis].item(), doc=doc)


class OriginalNames:
    """What can be read off the environment, by the original's names."""

    size = _reads(lambda env: env.base_env.size, "Dimensions of the camera buffer, reserved for vision.")
    length = _reads(lambda env: env.base_env.length, "Steps after which an episode ends.")
    _length = length
    lidar_points = _reads(lambda env: env.base_env.lidar.points, "Readings in the observation.")
    max_lidar_range = _reads(lambda env: env.base_env.lidar.max_range, "The lidar's readings are clipped to this, m.")

    world_n = _world(lambda world: world.name, "The world's name.")
    rand_x_range = _world(lambda world: world.spawn_range[0], "Where episodes start in x, (low, high), m.")
    rand_y_range = _world(lambda world: world.spawn_range[1], "Where episodes start in y, (low, high), m.")
    rand_goal_x_range = _world(lambda world: world.goal_range[0], "Where goals lie in x, (low, high), m.")
    rand_goal_y_range = _world(lambda world: world.goal_range[1], "Where goals lie in y, (low, high), m.")
    too_far_away_low_x = _world(lambda world: world.bounds[0][0], "The world's lower bound in x, m.")
    too_far_away_high_x = _world(lambda world: world.bounds[0][1], "The world's upper bound in x, m.")
    too_far_away_low_y = _world(lambda world: world.bounds[1][0], "The world's lower bound in y, m.")
    too_far_away_high_y = _world(lambda world: world.bounds[1][1], "The world's upper bound in y, m.")

    success_distance = _task(lambda task: task.success_distance, "A goal is reached below this distance, m.")
    collision_threshold = _task(lambda task: task.collision_threshold, "A reading below this is a collision, m.")
    collision_window = _task(lambda task: task.collision_window, "Collisions in a row beyond which it is a jam, steps.")
    stuck_window = _task(lambda task: task.stuck_window, "Positions remembered, steps.")
    stuck_threshold = _task(lambda task: task.stuck_threshold, "Less way than this over the window is stuck, m.")

    goal_reward = _reward(lambda reward: reward.goal_reward, "For reaching a goal.")
    distance_delta_scale = _reward(lambda reward: reward.distance_delta_scale, "For each metre gained.")
    final_reward_multiplier = _reward(lambda reward: reward.final_reward_multiplier, "On top of that.")
    collision_penalty = _reward(lambda reward: reward.collision_penalty, "For each step in collision.")
    stuck_penilty = _reward(lambda reward: reward.stuck_penalty, "For being stuck.")
    general_penility = _reward(lambda reward: reward.general_penalty, "For a flip or a jam.")
    too_far_away_penilty = _reward(lambda reward: reward.out_of_bounds_penalty, "For leaving the bounds.")

    current_roll = _euler(0, "Roll, rad.")
    current_pitch = _euler(1, "Pitch, rad.")
    current_yaw = _euler(2, "Yaw, rad.")
    current_linear_velocity = _reads(
        lambda env: env.base_env.sensed_state.linear_velocity.item(), "Forward speed by wheel odometry, m/s."
    )
    current_angular_velocity = _reads(
        lambda env: env.base_env.sensed_state.angular_velocity.item(), "Yaw rate by wheel odometry, rad/s."
    )
    rover_position = _reads(
        lambda env: env.base_env.sensed_state.position[0].numpy(force=True).copy(), "Position, float32 [3], m."
    )
    lidar_data = _reads(lambda env: env.get_observation()["lidar"], "The pooled scan, float32 [lidar_points], m.")
    target_positions_x = _reads(lambda env: env.base_env.goal[0, 0].item(), "The goal's x, m.")
    target_positions_y = _reads(lambda env: env.base_env.goal[0, 1].item(), "The goal's y, m.")


def _reward_config(env: GymWrapper) -> RewardConfig:
    if env.reward_config is None:
        raise AttributeError(
            "the contract's reward numbers are only known where this class has added its reward: "
            "give it a bare RoverEnv, with reward='contract' or a RewardConfig"
        )
    return env.reward_config
