"""Any robot: cars and skid-steer robots, small and large, slow and fast, in mazes and rooms."""

from __future__ import annotations

import math

from rover_rl.envs.config import ActionConfig, EnvConfig, HeadingGains, LidarConfig, RewardConfig, TaskConfig
from rover_rl.tasks.task import Task

# Settings of learners: a reward for progress around walls, a penalty for going where it has been, a critic that knows
# the way, and one of 55 actions at a time.
SETTINGS = {
    "num_envs": 1024,
    "gamma": 0.98,
    "path_reward": 5.0,
    "revisit_penalty": 0.6,
    "privileged_critic": True,
    "distribution": "grid",
    "entropy_coef": 0.001,
}
ANY_ROBOT = Task(
    name="any-robot",
    reason="How to turn in a passage depends on what turns: a car backs up where a rover turns in place.",
    # What a policy reads: 64 readings of the lidar (m), times to a contact of the body for 5 speeds and 11 yaw rates
    # (s), how long it has been at 49 places around it (s), pitch, roll and yaw (rad), distance (m) and angle (rad) of
    # the goal, speed (m/s) and yaw rate (rad/s) of the wheels, and numbers of the robot: size, speed, turning circle.
    observation=("lidar", "contact_times", "visits", "imu", "target", "velocities", "robot"),
    env=EnvConfig(
        # Worlds: 128 mazes and 128 floor plans, as wide as the robots need.
        world=("maze:0-127@0.2-0.9", "rooms:0-127@0-1"),
        # Robots: one of 256 in each episode.
        robot="any:0-255",
        # Sensors: a planar lidar of 128 beams, in the minima of 64 segments, what the robot is, what it would touch and
        # when, and where it has been.
        lidar=LidarConfig(points=64, beams=128, max_range=12.0, period=4),
        sensors=("robot", "contact_times(period=4)", "visits(period=4)"),
        # Action: speed (m/s) and heading offset (rad), which a PID follows within what each drive can do.
        action=ActionConfig(kind="heading", max_turn=math.pi),
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
        # Events: none. Length: 1,200 steps of 50 ms.
        length=1200,
        backend="warp",
    ),
    # Success: the goal, with one of 64 robots in one of 64 worlds, which no training has seen, within 120 s, untouched.
    test_world=("maze:50000-50031", "rooms:50000-50031"),
    test_robot="any:10000-10063",
    episodes=4,
    seconds=120.0,
    references=("scripted", "gridplanner", "dwa", "expert"),  # one for each robot
    learners={
        "ppo-gru": SETTINGS | {"memory": "gru", "rollout_length": 16},
        "ppo": SETTINGS,
        "sac": {"algo": "sac", "gamma": 0.98},
    },
)
