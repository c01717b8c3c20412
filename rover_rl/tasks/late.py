"""Late: mazes by sensors that are late, noisy and drift, with weak motors."""

from __future__ import annotations

import math

from rover_rl.envs.config import (
    ActionConfig,
    EnvConfig,
    HeadingGains,
    LidarConfig,
    LimitsConfig,
    PoseConfig,
    Randomization,
    RewardConfig,
    TaskConfig,
)
from rover_rl.tasks.task import Task

# Settings of learners: a reward for progress around walls, a penalty for going where it has been, a critic that knows
# the way and the delays, and one of 55 actions at a time, none of them backward.
SETTINGS = {
    "num_envs": 1024,
    "gamma": 0.98,
    "path_reward": 5.0,
    "revisit_penalty": 0.6,
    "privileged_critic": True,
    "action": ActionConfig(kind="heading", min_speed=0.0, max_speed=1.0, max_turn=math.pi),
    "distribution": "grid",
    "entropy_coef": 0.001,
}
LATE = Task(
    name="late",
    reason="What the sensors tell is old and wrong by an unknown amount: how far to trust it shows only in driving.",
    # What a policy reads: 32 readings of the lidar (m), and where they were taken (m, rad), times to a contact of the
    # body for 5 speeds and 11 yaw rates (s), how long it has been at 49 places around it (s), pitch, roll and yaw
    # (rad), distance (m) and angle (rad) of the goal, speed (m/s) and yaw rate (rad/s) of the wheels.
    observation=("lidar", "scan_pose", "contact_times", "visits", "imu", "target", "velocities"),
    env=EnvConfig(
        # Worlds: 300 mazes with passages of 1 m, and 300 forests.
        world=("maze:0-299@0-0.9", "forest:0-299@0.2-1"),
        # Robot: Rover Zero, 0.53 x 0.45 m, skid-steer, which turns in place.
        robot="rover_zero",
        # Sensors: a planar lidar of 128 beams all around, in the minima of 32 segments, what the rover would touch and
        # when, and where it has been. Messages have stamps, and a model of the drive carries late poses and velocities
        # on to now.
        lidar=LidarConfig(points=32, beams=128, max_range=12.0),
        sensors=("contact_times(period=4)", "visits(period=4)"),
        compensate_delay=True,
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
        # Events: in each episode other delays (control steps), noise (standard deviations), grip, mass and motors.
        randomization=Randomization(
            latency=(0, 3),
            scan_latency=(0, 4),
            state_latency=(0, 4),
            lost_scans=0.1,
            range_noise=0.04,
            dropout=0.08,
            odometry_noise=0.05,
            imu_noise=0.02,
            odometry_scale=(0.95, 1.05),
            yaw_bias=(-math.radians(0.3), math.radians(0.3)),
            severity=(0.0, 1.0),  # factor of all noise
            limits=(0.5, 1.0),
            friction=(0.5, 1.5),
            chassis_mass=(0.8, 1.6),
            motor_torque=(0.5, 1.0),
        ),
        pose=PoseConfig(
            "either", drift=0.08, drift_heading=0.03, jump=0.12, jump_rate=1.0, jump_heading=math.radians(4)
        ),
        limits=LimitsConfig(apply=True),
        # Length: 1,200 steps of 50 ms.
        length=1200,
        backend="warp",
    ),
    # Success: the goal, in one of 64 worlds that no training has seen, within 60 s and without a contact of the body.
    test_world=("maze:50000-50031", "forest:50000-50031"),
    episodes=4,
    seconds=60.0,
    references=("scripted", "gridplanner", "dwa", "expert"),
    learners={
        "ppo-gru": SETTINGS | {"memory": "gru", "rollout_length": 16},
        "ppo": SETTINGS,
        "sac": {"algo": "sac", "gamma": 0.98},
    },
)
