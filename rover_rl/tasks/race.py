"""Race: a car of 5 m/s and a Jackal of 2 m/s, to the goal as fast as the grip allows."""

from __future__ import annotations

from rover_rl.envs.config import ActionConfig, EnvConfig, LidarConfig, Randomization, RewardConfig, TaskConfig
from rover_rl.tasks.task import Task

# Settings of learners: a reward for progress around obstacles, a penalty for going where it has been, a critic that
# knows the way and the grip, and actions that leave little to chance in the end.
SETTINGS = {
    "num_envs": 1024,
    "minibatch": 2048,
    "epochs": 4,
    "rollout_length": 16,
    "gamma": 0.97,
    "action_repeat": 2,
    "hidden": (256, 128),
    "path_reward": 5.0,
    "revisit_penalty": 0.6,
    "privileged_critic": True,
    "max_std": 1.0,
    "final_std": 0.15,
}
RACE = Task(
    name="race",
    reason="At the limit of grip, where a turn ends depends on speed and slip: how fast is too fast has to be felt.",
    # What a policy reads: 64 readings of the lidar (m), times to a contact of the body for 5 speeds and 11 yaw rates
    # (s), how long it has been at 49 places around it (s), pitch, roll and yaw (rad), distance (m) and angle (rad) of
    # the goal, speed (m/s) and yaw rate (rad/s) of the wheels, and numbers of the robot: size, speed, turning circle.
    observation=("lidar", "contact_times", "visits", "imu", "target", "velocities", "robot"),
    env=EnvConfig(
        # Worlds: 300 forests, as wide as the robots need, from open (0) to dense (1).
        world="forest:0-299@0-0.6",
        # Robots: one of the two in each episode.
        robot=("racer", "jackal"),
        # Sensors: a planar lidar of 128 beams, in the minima of 64 segments, what the robot is, what it would touch and
        # when, and where it has been.
        lidar=LidarConfig(points=64, beams=128, max_range=12.0),
        sensors=("robot", "contact_times(period=2)", "visits(period=2)"),
        # Action: speed (m/s) and yaw rate (rad/s), which the drive follows.
        action=ActionConfig(kind="twist"),
        # Rewards of a step. Of an ending, the goal and driving, the first that happens pays.
        contract_reward=RewardConfig(
            goal_reward=100.0,
            distance_delta_scale=0.3,  # driving: for each meter nearer to the goal, times final_reward_multiplier
            final_reward_multiplier=1.5,
            idle_penalty=-0.3,  # in place of it, for less than min_progress (m) or with the back to the goal
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
        # Events: another grip in each episode.
        randomization=Randomization(friction=(0.6, 1.0)),
        # Length: 600 steps of 50 ms.
        length=600,
        backend="warp",
    ),
    # Success: the goal, in one of 64 forests that no training has seen, within 15 s and without a contact of the body.
    test_world="forest:50000-50063",
    episodes=4,
    seconds=15.0,
    references=("scripted", "gridplanner", "dwa", "expert"),  # one for each robot
    learners={
        "ppo-gru": SETTINGS | {"memory": "gru"},
        "ppo": SETTINGS,
        "sac": {"algo": "sac", "num_envs": 64, "gamma": 0.97, "action_repeat": 2},
    },
)
