"""TQC, CrossQ and RecurrentPPO of sb3-contrib on a batch of rovers: ``pip install sb3-contrib``."""

import sys

import torch
from sb3_contrib import TQC, CrossQ, RecurrentPPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import VecMonitor

from rover_rl import RoverEnv
from rover_rl.envs.sb3 import SB3VecEnv

DECISIONS = 400_000  # of all rovers together, each of 4 steps
ROVERS = 128
ALGORITHM = sys.argv[1] if len(sys.argv) > 1 else "TQC"

torch.set_num_threads(1)  # small networks do not gain from more threads
rovers = RoverEnv(world_n="inspect", num_envs=ROVERS, seed=0, backend="warp")
envs = VecMonitor(SB3VecEnv(rovers, action_repeat=4, reward_scale=0.05, scale_observations=True))
on_policy = {"n_steps": 64, "batch_size": 256}  # by default, 2048 steps of each rover before the first update
off_policy = {
    "gradient_steps": 16,  # by default, one update for each step of the batch of rovers
    "ent_coef": "auto_0.05",  # by default 1 at first: more than the rewards, so that learning begins late
    "policy_kwargs": {"net_arch": [128, 128]},  # by default 256 to 1024 wide: slow on a CPU
}
model = {
    "PPO": lambda: PPO("MlpPolicy", envs, device="cpu", seed=0, verbose=1, **on_policy),
    "SAC": lambda: SAC("MlpPolicy", envs, device="cpu", seed=0, verbose=1, **off_policy),
    "TQC": lambda: TQC("MlpPolicy", envs, device="cpu", seed=0, verbose=1, **off_policy),
    "CrossQ": lambda: CrossQ("MlpPolicy", envs, device="cpu", seed=0, verbose=1, **off_policy),
    "RecurrentPPO": lambda: RecurrentPPO("MlpLstmPolicy", envs, device="cpu", seed=0, verbose=1, **on_policy),
}[ALGORITHM]()
model.learn(DECISIONS, log_interval=4 if "PPO" in ALGORITHM else 200)
model.save(ALGORITHM)  # rover-rl evaluate TQC.zip --world inspect --action-repeat 4
envs.close()
