"""Training with SAC of Stable-Baselines3 on a batch of rovers.

    pip install -e ".[sb3]"
    python examples/sb3_sac.py                    # 200,000 steps: a few minutes
    python examples/sb3_sac.py --steps 600000     # the default of `rover-rl train --algo sac`

All rovers form one `VecEnv`, which steps them as one batch in this process. SB3 prints a table during training, where
`success_rate` is the fraction of recent episodes that reached a goal. The script then evaluates the policy without
exploration.
"""

from __future__ import annotations

import numpy as np
import torch
import tyro
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecMonitor
from torchrl.envs import RewardScaling

from rover_rl import make_env
from rover_rl.algos.policy.networks import ObservationEncoder
from rover_rl.envs.sb3 import SB3VecEnv
from rover_rl.envs.transforms.action_repeat import ActionRepeat

ACTION_REPEAT = 4  # steps of 0.05 s per action: exploration noise at 20 Hz averages out


class RoverFeatures(BaseFeaturesExtractor):
    """Features of the networks: the observation, scaled for this task. Unscaled observations do not train well."""

    def __init__(self, observation_space: spaces.Dict) -> None:
        encoder = ObservationEncoder()
        super().__init__(observation_space, encoder.features)
        self.encoder = encoder

    def forward(self, observation: dict[str, torch.Tensor]) -> torch.Tensor:
        return self.encoder(*(observation[key] for key in self.encoder.keys))


def make_rovers(world: str, rovers: int, seed: int) -> VecMonitor:
    """A batch of rovers with actions at 5 Hz and episodes of 30 s. ``VecMonitor`` reports returns to SB3."""
    env = make_env(world_n=world, num_envs=rovers, length=600, seed=seed)
    env = env.append_transform(ActionRepeat(ACTION_REPEAT)).append_transform(RewardScaling(loc=0.0, scale=0.05))
    return VecMonitor(SB3VecEnv(env))


def evaluate(model: SAC, world: str, rovers: int, actions: int) -> None:
    """Prints how many rovers reach a goal within ``actions`` actions, without exploration."""
    envs = make_rovers(world, rovers, seed=1_000)
    observation = envs.reset()
    reached = np.zeros(rovers, bool)
    for _ in range(actions):
        action, _ = model.predict(observation, deterministic=True)
        observation, _, ended, infos = envs.step(action)
        reached |= [bool(end and info["is_success"]) for end, info in zip(ended, infos, strict=True)]
    print(f"{reached.sum()} of {rovers} rovers reached a goal")
    envs.close()


def main(steps: int = 200_000, world: str = "maze", rovers: int = 64) -> None:
    """Trains a policy with SAC and evaluates it.

    Args:
        steps: total number of environment steps of all rovers.
        world: name of the world.
        rovers: number of rovers in the batch.
    """
    torch.set_num_threads(1)  # small networks do not gain from more threads
    envs = make_rovers(world, rovers, seed=0)
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
    model.learn(steps // ACTION_REPEAT, log_interval=50)
    envs.close()
    evaluate(model, world, rovers, actions=min(150, steps // ACTION_REPEAT))


if __name__ == "__main__":
    tyro.cli(main)
