"""Hills: slopes on which the wheels lose their grip, by a scan of the heights ahead."""

from __future__ import annotations

import math

from rover_rl.envs.config import (
    ActionConfig,
    EnvConfig,
    HeadingGains,
    LidarConfig,
    Randomization,
    RewardConfig,
    TaskConfig,
)
from rover_rl.tasks.task import Task

# Settings of learners: a reward for progress around walls, a penalty for going where it has been, a critic that knows
# the way and the grip, and one of 55 actions at a time.
SETTINGS = {
    "num_envs": 1024,
    "gamma": 0.98,
    "path_reward": 5.0,
    "revisit_penalty": 0.6,
    "privileged_critic": True,
    "image_network": "patches",
    "distribution": "grid",
}
HILLS = Task(
    name="hills",
    reason="How steep is too steep depends on the grip, which no sensor tells: it shows in how the wheels slip.",
    # What a policy reads: heights of the ground around it (m), how long it has been at 49 places around it (s), pitch,
    # roll and yaw (rad), distance (m) and angle (rad) of the goal, speed (m/s) and yaw rate (rad/s) of the wheels.
    observation=("heights", "visits", "imu", "target", "velocities"),
    env=EnvConfig(
        # Worlds: 300 hilly grounds, from gentle (0) to steep (1).
        world="hills:0-299@0.2-1",
        # Robot: Rover Zero, 0.53 x 0.45 m, skid-steer, which turns in place.
        robot="rover_zero",
        # Sensors: a scan of heights, and where the rover has been. The lidar is for planners, to compare with.
        sensors=("heights", "visits(period=4)"),
        lidar=LidarConfig(points=32, beams=128, max_range=12.0, period=4),
        # Action: speed (m/s) and heading offset (rad), which a PID follows.
        action=ActionConfig(kind="heading", min_speed=-1.0, max_speed=1.0, max_turn=math.pi),
        heading_gains=HeadingGains(kp=2.0, ki=0.0, kd=0.1, max_output=7.0),
        # Rewards of a step. Of an ending, the goal and driving, the first that happens pays.
        contract_reward=RewardConfig(
            goal_reward=100.0,
            distance_delta_scale=0.3,  # driving: for each meter nearer to the goal, times final_reward_multiplier
            final_reward_multiplier=1.5,
            idle_penalty=-0.1,  # in place of it, for less than min_progress (m) or with the back to the goal
            min_progress=0.001,
            velocity_scale=0.0025,  # for each m/s
            turn_scale=-0.0015,  # for each rad/s
            general_penalty=-30.0,  # ended by a contact, or on its back
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
        # Events: another grip in each episode, from gravel (half) to that of a dry floor.
        randomization=Randomization(friction=(0.5, 1.0)),
        # Length: 1,200 steps of 50 ms.
        length=1200,
        backend="warp",
    ),
    # Success: the goal, in one of 64 steep hills that no training has seen, within 60 s and not on its back.
    test_world="hills:50000-50063@0.5-1",
    episodes=4,
    seconds=60.0,
    references=("scripted", "gridplanner", "dwa", "expert"),
    learners={
        "ppo-gru": SETTINGS | {"memory": "gru", "rollout_length": 16},
        "ppo": SETTINGS,
        "sac": {"algo": "sac", "gamma": 0.98},
    },
)
