"""Mazes: a maze that the policy has never seen, another one in each episode."""

from __future__ import annotations

import math

from rover_rl.envs.config import ActionConfig, EnvConfig, HeadingGains, LidarConfig, RewardConfig, TaskConfig
from rover_rl.tasks.task import Task

# Settings of learners: a reward for progress around walls, a penalty for going where it has been, a critic that knows
# the way, and one of 55 actions at a time, none of them backward.
SETTINGS = {
    "total_steps": 4_500_000,
    "num_envs": 1024,
    "gamma": 0.98,
    "path_reward": 5.0,
    "revisit_penalty": 0.6,
    "privileged_critic": True,
    "action": ActionConfig(kind="heading", min_speed=0.0, max_speed=1.0, max_turn=math.pi),
    "distribution": "grid",
    "entropy_coef": 0.001,
}
MAZES = Task(
    name="mazes",
    reason="A dead end looks like a way until the rover is in it, so that what was seen before has to be remembered.",
    # What a policy reads: 32 readings of the lidar (m), times to a contact of the body for 5 speeds and 11 yaw rates
    # (s), how long it has been at 49 places around it (s), pitch, roll and yaw (rad), distance (m) and angle (rad) of
    # the goal, speed (m/s) and yaw rate (rad/s) of the wheels.
    observation=("lidar", "contact_times", "visits", "imu", "target", "velocities"),
    env=EnvConfig(
        # Worlds: 1,000 mazes with passages of 1 m, from easy (0) to hard (1).
        world="maze:0-999@0-1",
        # Robot: Rover Zero, 0.53 x 0.45 m, skid-steer, which turns in place.
        robot="rover_zero",
        # Sensors: a planar lidar of 128 beams all around, in the minima of 32 segments, what the rover would touch and
        # when, and where it has been.
        lidar=LidarConfig(points=32, beams=128, max_range=12.0),
        sensors=("contact_times(period=4)", "visits(period=4)"),
        # Action: speed (m/s) and heading offset (rad), which a PID follows.
        action=ActionConfig(kind="heading", min_speed=-1.0, max_speed=1.0, max_turn=math.pi),
        heading_gains=HeadingGains(kp=2.0, ki=0.0, kd=0.1, max_output=7.0),
        # Rewards of a step. Of an ending, the goal and driving, the first that happens pays.
        contract_reward=RewardConfig(
            goal_reward=100.0,
            distance_delta_scale=0.3,  # driving: for each meter nearer to the goal, times final_reward_multiplier
            final_reward_multiplier=1.5,
            idle_penalty=-0.03,  # in place of it, for less than min_progress (m) or with the back to the goal
            min_progress=0.001,
            velocity_scale=0.0025,  # for each m/s
            turn_scale=-0.0015,  # for each rad/s
            general_penalty=-20.0,  # ended by a contact, or on its back
            flip_grace_steps=0,
            stuck_penalty=-25.0,
            out_of_bounds_penalty=-10.0,
        ),
        # Terminations: any contact of the body, on its back, out of bounds, 1 mm in 30 s.
        task=TaskConfig(
            success_distance=0.5,
            min_goal_distance=1.0,
            collision_from="contact",
            collision_window=0,
            flip_threshold=1.48,
            stuck_window=600,
            stuck_threshold=0.001,
        ),
        # Events: none. Length: 1,200 steps of 50 ms.
        length=1200,
        backend="warp",
    ),
    # Success: the goal, in one of 64 mazes that no training has seen, within 60 s and without a contact of the body.
    test_world="maze:50000-50063",
    episodes=4,
    seconds=60.0,
    references=("scripted", "gridplanner", "dwa", "expert"),
    learners={
        "ppo-gru": SETTINGS | {"memory": "gru", "rollout_length": 16},
        "ppo": SETTINGS,
        "sac": {"algo": "sac", "gamma": 0.98},
    },
)
