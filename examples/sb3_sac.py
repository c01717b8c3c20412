"""
Stable-Baselines3
=================

SAC of Stable-Baselines3 learns on a batch of rovers. All rovers form one ``VecEnv``, which steps them as one batch in
this process. The extra ``sb3`` installs Stable-Baselines3.
"""

# sphinx_gallery_thumbnail_path = 'images/generator_moon.png'
from __future__ import annotations

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecMonitor
from torchrl.envs import RewardScaling

from rover_rl import make_env
from rover_rl.algos.policy.networks import ObservationEncoder
from rover_rl.envs.sb3 import SB3VecEnv
from rover_rl.envs.transforms.action_repeat import ActionRepeat

STEPS = 16_000  # of all rovers together; 600_000 for a good policy
EPISODE = 200  # steps; 600 in a long training
ROVERS = 64
WORLD = "inspect"
ACTION_REPEAT = 4  # steps of 0.05 s per action: exploration noise at 20 Hz averages out

torch.set_num_threads(1)  # small networks do not gain from more threads

# %%
# Scaled observations
# -------------------
# Unscaled observations do not train well. ``ObservationEncoder`` scales them for this task.


class RoverFeatures(BaseFeaturesExtractor):
    def __init__(self, observation_space: spaces.Dict) -> None:
        encoder = ObservationEncoder()
        super().__init__(observation_space, encoder.features)
        self.encoder = encoder

    def forward(self, observation: dict[str, torch.Tensor]) -> torch.Tensor:
        return self.encoder(*(observation[key] for key in self.encoder.keys))


# %%
# The batch as a ``VecEnv``
# -------------------------
# Actions at 5 Hz and a scaled reward. ``VecMonitor`` reports returns to SB3.


def make_rovers(seed: int) -> VecMonitor:
    env = make_env(world_n=WORLD, num_envs=ROVERS, length=EPISODE, seed=seed, backend="warp")
    env = env.append_transform(ActionRepeat(ACTION_REPEAT))
    env = env.append_transform(RewardScaling(loc=0.0, scale=0.05))
    return VecMonitor(SB3VecEnv(env))


# %%
# Training
# --------
# SB3 prints a table during training, where ``success_rate`` is the fraction of recent episodes that reached a goal.

envs = make_rovers(seed=0)
model = SAC(
    "MultiInputPolicy",
    envs,
    learning_rate=1e-3,
    gamma=0.96,
    learning_starts=2_000,
    gradient_steps=16,
    ent_coef="auto_0.02",
    target_entropy=-3.0,
    policy_kwargs={"net_arch": [128, 128], "features_extractor_class": RoverFeatures},
    device="cpu",
    seed=0,
    verbose=1,
)
model.learn(STEPS // ACTION_REPEAT, log_interval=ROVERS)
envs.close()

# %%
# Evaluation
# ----------
# Without exploration, on episodes that the training has not seen.

envs = make_rovers(seed=1_000)
observation = envs.reset()
reached = np.zeros(ROVERS, bool)
for _ in range(EPISODE // ACTION_REPEAT):
    action, _ = model.predict(observation, deterministic=True)
    observation, _, ended, infos = envs.step(action)
    reached |= [bool(end and info["is_success"]) for end, info in zip(ended, infos, strict=True)]
print(f"{reached.sum()} of {ROVERS} rovers reached a goal")
envs.close()
