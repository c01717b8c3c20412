"""Rooms with people: a floor plan that the policy has never seen, in which people walk."""

from __future__ import annotations

import math

from rover_rl.envs.config import ActionConfig, EnvConfig, HeadingGains, LidarConfig, RewardConfig, TaskConfig
from rover_rl.tasks.task import Task

# Settings of learners: a reward for progress around walls, a critic that knows the way and what moves, worlds that are
# neither too easy nor too hard, and one of 55 actions at a time. The first tenth imitates a planner that knows what
# moves, which drives nothing.
SETTINGS = {
    "num_envs": 1024,
    "minibatch": 2048,
    "epochs": 4,
    "rollout_length": 16,
    "gamma": 0.995,
    "action_repeat": 2,
    "path_reward": 5.0,
    "privileged_critic": True,
    "curriculum": "learnability",
    "distribution": "grid",
    "entropy_coef": 0.001,
    "expert": "predictive",
    "imitation": 0.1,
}
ROOMS_PEOPLE = Task(
    name="rooms-people",
    reason="Doors are as wide as one: who comes through them has to be seen coming, waited for and given way to.",
    # What a policy reads: 128 readings of the lidar (m), places, velocities and sizes of what moves (m, m/s), times to
    # a contact of the body for 5 speeds and 11 yaw rates (s), pitch, roll and yaw (rad), distance (m) and angle (rad)
    # of the goal, speed and yaw rate (m/s, rad/s).
    observation=("lidar", "movers", "contact_times", "imu", "target", "velocities"),
    env=EnvConfig(
        # Worlds: 300 floor plans with 2 to 10 people per 100 square meters, who wander.
        world="rooms+walkers:0-299@0-1",
        # Robot: Rover Zero, 0.53 x 0.45 m, skid-steer, which turns in place.
        robot="rover_zero",
        # Sensors: a planar lidar of 128 beams all around, what moves in its scans, and what the rover would touch and
        # when.
        lidar=LidarConfig(points=128, beams=128, max_range=12.0, period=2),
        sensors=("movers(period=2)", "contact_times(period=2)"),
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
            general_penalty=-100.0,  # ended by a contact, or on its back
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
    # Success: the goal, in one of 64 floor plans that no training has seen, within 60 s and without touching anything.
    test_world="rooms+walkers:50000-50063",
    episodes=4,
    seconds=60.0,
    references=("scripted", "gridplanner-moving", "dwa", "predictive"),
    learners={
        "ppo-gru": SETTINGS | {"memory": "gru"},
        "ppo": SETTINGS | {"hidden": (256, 128)},
        "sac": {"algo": "sac", "num_envs": 64, "gamma": 0.98, "action_repeat": 2},
    },
)
