"""Moon: rough ground with boulders, the second of the original's worlds."""

from __future__ import annotations

import math

from rover_rl.envs.config import ActionConfig, EnvConfig, HeadingGains, LidarConfig, RewardConfig, TaskConfig
from rover_rl.tasks.task import Task

# Settings of learners: a reward for progress around obstacles, a critic that knows the way, episodes that end at a
# contact, as in the test, and actions that leave little to chance in the end.
SETTINGS = {
    "num_envs": 1024,
    "length": 600,
    "gamma": 0.98,
    "path_reward": 5.0,
    "privileged_critic": True,
    "task": TaskConfig(collision_from="contact", collision_window=0),
    "contract_reward": RewardConfig(general_penalty=-50.0),
    "max_std": 1.0,
    "final_std": 0.15,
}
MOON = Task(
    name="moon",
    reason="The lidar looks over low boulders and into slopes: what the ground is like shows in pitch, roll and slip.",
    # What a policy reads: 32 readings of the lidar (m), pitch, roll and yaw (rad), distance (m) and angle (rad) of the
    # goal, speed (m/s) and yaw rate (rad/s) of the wheels.
    observation=("lidar", "imu", "target", "velocities"),
    env=EnvConfig(
        # World: moon, with other starts and goals in each episode, and the next goal where one is reached.
        world="moon",
        end_on_goal=False,
        # Robot: Rover Zero, 0.53 x 0.45 m, skid-steer, which turns in place.
        robot="rover_zero",
        # Sensors: a planar lidar of 128 beams all around, in the minima of 32 segments.
        lidar=LidarConfig(points=32, beams=128, max_range=12.0),
        # Action: speed (m/s) and heading offset (rad), which a PID follows.
        action=ActionConfig(kind="heading", min_speed=-1.0, max_speed=1.0, max_turn=math.pi),
        heading_gains=HeadingGains(kp=2.0, ki=0.0, kd=0.1, max_output=7.0),
        # Rewards of a step. Of an ending, the goal, a collision and driving, the first that happens pays.
        contract_reward=RewardConfig(
            goal_reward=100.0,
            distance_delta_scale=0.3,  # driving: for each meter nearer to the goal, times final_reward_multiplier
            final_reward_multiplier=1.5,
            idle_penalty=-0.03,  # in place of it, for less than min_progress (m) or with the back to the goal
            min_progress=0.001,
            velocity_scale=0.0025,  # for each m/s
            turn_scale=-0.0015,  # for each rad/s
            collision_penalty=-0.5,
            general_penalty=-20.0,  # ended by a flip, after flip_grace_steps, or by a long collision
            flip_grace_steps=500,
            stuck_penalty=-25.0,
            out_of_bounds_penalty=-10.0,
        ),
        # Terminations: on its back, 16 steps in collision (a reading below 0.3 m), out of bounds, 1 mm in 30 s.
        task=TaskConfig(
            success_distance=0.5,
            min_goal_distance=1.0,
            collision_from="lidar",
            collision_threshold=0.3,
            collision_window=15,
            flip_threshold=1.48,
            stuck_window=600,
            stuck_threshold=0.001,
        ),
        # Events: none. Length: 2,000 steps of 50 ms.
        length=2000,
        backend="warp",
    ),
    # Success: one of 256 goals within 60 s, and without a contact of the body.
    test_world="moon",
    episodes=256,
    seconds=60.0,
    references=("scripted", "gridplanner", "dwa", "expert"),
    learners={
        "ppo": SETTINGS,
        "ppo-gru": SETTINGS | {"memory": "gru", "rollout_length": 16},
        "sac": {"algo": "sac", "num_envs": 64, "length": 600},
    },
)
