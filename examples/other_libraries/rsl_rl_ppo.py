"""PPO of rsl_rl on a batch of rovers: ``pip install rsl-rl-lib``."""

import torch
from rsl_rl.runners import OnPolicyRunner

from rover_rl import RoverEnv
from rover_rl.envs.wrappers.rsl_rl import RslRlVecEnv

DECISIONS = 500_000  # of all rovers together, each of 4 steps
ROVERS = 256
STEPS_PER_UPDATE = 32

torch.set_num_threads(1)  # small networks do not gain from more threads
torch.manual_seed(0)
rovers = RoverEnv(world_n="inspect", num_envs=ROVERS, seed=0, backend="warp")
envs = RslRlVecEnv(rovers, action_repeat=4, reward_scale=0.05, scale_observations=True)
gaussian = {"class_name": "GaussianDistribution", "init_std": 1.0}
settings = {
    "num_steps_per_env": STEPS_PER_UPDATE,
    "obs_groups": {"actor": ["observation"], "critic": ["observation"]},
    "save_interval": 100,
    "logger": "tensorboard",
    "actor": {"class_name": "MLPModel", "hidden_dims": [128, 128], "distribution_cfg": gaussian},
    "critic": {"class_name": "MLPModel", "hidden_dims": [128, 128]},
    "algorithm": {"class_name": "PPO", "entropy_coef": 0.005, "learning_rate": 1e-3, "schedule": "adaptive"},
}
runner = OnPolicyRunner(envs, settings, log_dir="runs/rsl_rl", device="cpu")
runner.learn(DECISIONS // (ROVERS * STEPS_PER_UPDATE), init_at_random_ep_len=True)
envs.close()
