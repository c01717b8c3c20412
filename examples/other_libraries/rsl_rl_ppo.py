"""PPO of rsl_rl learns a task on a batch of rovers: ``pip install rsl-rl-lib``."""

import math
import sys

import torch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict
from torchrl.envs import RewardScaling

from rover_rl import get_task, make_env
from rover_rl.envs.encoding import EncodedObservation, ObservationEncoder
from rover_rl.envs.transforms.action_repeat import ActionRepeat

TASK, SEED, DECISIONS = sys.argv[1:4] if len(sys.argv) > 3 else ("inspect", 0, 500_000)  # decisions of 4 steps
ROVERS = 256
STEPS_PER_UPDATE = 32


class Rovers(VecEnv):
    """Rovers with an action every 0.2 s, one vector of features, and a scaled reward."""

    def __init__(self, task: str, repeat: int = 4, **settings) -> None:
        self.env = make_env(task=task, backend="warp", **settings)
        encoder = ObservationEncoder.of(self.env.config, get_task(task).observation)
        for transform in (ActionRepeat(repeat), RewardScaling(loc=0.0, scale=0.05), EncodedObservation(encoder)):
            self.env = self.env.append_transform(transform)
        self.num_envs, self.num_actions = self.env.action_spec.shape
        self.device, self.cfg = self.env.device or torch.device("cpu"), {}
        self.max_episode_length = math.ceil(self.env.config.length / repeat)
        self.reset()

    def reset(self):
        self.root = self.env.reset()
        # The runner sets it to random numbers, so that episodes do not end at the same time.
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        self.reached = torch.zeros_like(self.episode_length_buf, dtype=torch.bool)
        return self.get_observations(), {}

    def get_observations(self) -> TensorDict:
        return self.root.select("observation").clone()

    def step(self, actions: torch.Tensor):
        result = self.env.step(self.root.set("action", actions))
        after, self.root = result["next"], self.env.step_mdp(result)
        self.episode_length_buf = self.episode_length_buf + 1
        terminated, truncated = after["terminated"].squeeze(-1), after["truncated"].squeeze(-1)
        timed_out = truncated | (self.episode_length_buf >= self.max_episode_length)
        done = terminated | timed_out
        reward = after["reward"].squeeze(-1).clone()
        self.reached = self.reached | after["outcome", "goal_reached"].squeeze(-1)
        extras = {"time_outs": timed_out & ~terminated}
        if done.any():
            extras["log"] = {"/success": self.reached[done].float().mean()}
            self.root = self.env.reset(self.root.set("_reset", done[:, None]))
            self.episode_length_buf = self.episode_length_buf.masked_fill(done, 0)
            self.reached = self.reached & ~done
        return self.get_observations(), reward, done, extras


torch.set_num_threads(1)  # small networks do not gain from more threads
torch.manual_seed(int(SEED))
envs = Rovers(TASK, num_envs=ROVERS, seed=int(SEED))
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
runner.learn(int(DECISIONS) // (ROVERS * STEPS_PER_UPDATE), init_at_random_ep_len=True)
