"""PPO of Stable-Baselines3 with its default hyperparameters learns a task: ``pip install "rover_rl[sb3]"``.

By default, the rollout has 2,048 decisions of one environment. Here, all rovers together take as many.
"""

import sys

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

from rover_rl import RoverEnv, get_task
from rover_rl.envs.sb3 import SB3VecEnv

TASK, SEED, DECISIONS = sys.argv[1:4] if len(sys.argv) > 3 else ("inspect", 0, 300_000)  # decisions of 4 steps
ROVERS = 64

torch.set_num_threads(1)  # small networks do not gain from more threads
task = get_task(TASK)
rovers = RoverEnv(task=TASK, num_envs=ROVERS, seed=int(SEED), backend="warp")
options = {"action_repeat": 4, "reward_scale": 0.05, "scale_observations": True}
envs = VecMonitor(SB3VecEnv(rovers, observation=task.observation, **options))
model = PPO("MlpPolicy", envs, n_steps=2048 // ROVERS, seed=int(SEED), device="cpu", verbose=1)
model.learn(int(DECISIONS), log_interval=10)
model.save("sb3_ppo")  # rover-rl evaluate inspect sb3_ppo.zip --action-repeat 4
envs.close()
