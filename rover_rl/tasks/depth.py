"""Depth: rough ground by a depth camera alone, without a lidar."""

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

# Settings of learners: a reward for progress around boulders, a critic that knows the way, and one of 55 actions at a
# time.
SETTINGS = {
    "num_envs": 1024,
    "gamma": 0.98,
    "path_reward": 5.0,
    "privileged_critic": True,
    "image_network": "patches",
    "distribution": "grid",
}
DEPTH = Task(
    name="depth",
    reason="A picture of 16 x 32 distances has to become ground that carries, and boulders that do not, without a map.",
    # What a policy reads: a picture of distances (m), pitch, roll and yaw (rad), distance (m) and angle (rad) of the
    # goal, speed (m/s) and yaw rate (rad/s) of the wheels.
    observation=("depth", "imu", "target", "velocities"),
    env=EnvConfig(
        # Worlds: 128 moons with boulders and craters.
        world="moon:0-127",
        # Robot: Rover Zero, 0.53 x 0.45 m, skid-steer, which turns in place.
        robot="rover_zero",
        # Sensors: a camera of 115 degrees that looks down by 20. The lidar is for planners, to compare with. It sees as
        # much to both sides.
        sensors=("depth(size=(16, 32), field_of_view=2.0, max_range=6.0, pitch=0.35)",),
        lidar=LidarConfig(points=32, beams=128, max_range=12.0, period=4),
        randomization=Randomization(lidar_view=(2.0, 2.0)),
        # Action: speed (m/s) and heading offset (rad), which a PID follows. Nothing looks back.
        action=ActionConfig(kind="heading", min_speed=0.0, max_speed=1.0, max_turn=math.pi),
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
            general_penalty=-50.0,  # ended by a contact, or on its back
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
        # Events: none. Length: 600 steps of 50 ms.
        length=600,
        backend="warp",
    ),
    # Success: the goal, on one of 64 moons that no training has seen, within 60 s and without a contact of the body.
    test_world="moon:50000-50063",
    episodes=4,
    seconds=60.0,
    references=("scripted", "gridplanner", "dwa", "expert"),  # by that lidar
    learners={
        "ppo": SETTINGS,
        "ppo-gru": SETTINGS | {"memory": "gru", "rollout_length": 16},
        "sac": {"algo": "sac", "num_envs": 64, "gamma": 0.98},
    },
)
