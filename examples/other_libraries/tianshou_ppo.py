"""PPO of tianshou on a batch of rovers: ``pip install tianshou``.

Tianshou's vector environments step one environment after another. ``RoverBatch`` steps all of them at once instead.
"""

import numpy as np
import torch
from tianshou.algorithm.modelfree.ppo import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import BaseVectorEnv
from tianshou.trainer import OnPolicyTrainerParams
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic

import rover_rl
from rover_rl.envs.gym import make_vector_env

DECISIONS = 500_000  # of all rovers together, each of 4 steps
ROVERS = 256
STEPS_PER_UPDATE = 32


class RoverBatch(BaseVectorEnv):
    """Vector environment of tianshou that steps a batch. It collects a number of steps, not of episodes."""

    def __init__(self, **settings):
        self.batch = make_vector_env(autoreset_mode="Disabled", **settings)
        self.env_num, self.is_async, self.is_closed = self.batch.num_envs, False, False
        self.ready_id = list(range(self.env_num))

    def get_env_attr(self, key, id=None):
        return [getattr(self.batch, f"single_{key}", None)] * len(self._wrap_id(id))

    def reset(self, env_id=None, **kwargs):
        rows = np.isin(range(self.env_num), self._wrap_id(env_id))
        observations, _ = self.batch.reset(options={"reset_mask": rows}, **kwargs)
        return observations[rows], np.array([{} for _ in range(rows.sum())])

    def step(self, action, id=None):
        *results, _ = self.batch.step(action)
        return *results, np.array([{"env_id": row} for row in range(self.env_num)])

    def seed(self, seed=None):
        self.batch.reset(seed=seed)
        return [seed]

    def close(self):
        self.batch.close()


def normal(parameters):
    return torch.distributions.Independent(torch.distributions.Normal(*parameters), 1)


torch.set_num_threads(1)  # small networks do not gain from more threads
torch.manual_seed(0)
settings = rover_rl.LEARNING_DEFAULTS
envs = RoverBatch(num_envs=ROVERS, world_n="inspect", seed=0, **settings)
shape, actions = envs.batch.single_observation_space.shape, envs.batch.single_action_space
actor = ContinuousActorProbabilistic(
    preprocess_net=Net(state_shape=shape, hidden_sizes=[128, 128], activation=torch.nn.Tanh),
    action_shape=actions.shape,
    unbounded=True,
)
critic = ContinuousCritic(preprocess_net=Net(state_shape=shape, hidden_sizes=[128, 128], activation=torch.nn.Tanh))
algorithm = PPO(
    policy=ProbabilisticActorPolicy(actor=actor, dist_fn=normal, action_space=actions),
    critic=critic,
    optim=AdamOptimizerFactory(lr=3e-4),
    max_grad_norm=0.5,
)
batch = ROVERS * STEPS_PER_UPDATE
collector = Collector(algorithm, envs, VectorReplayBuffer(batch, ROVERS))
algorithm.run_training(
    OnPolicyTrainerParams(
        training_collector=collector,
        test_collector=None,
        max_epochs=DECISIONS // (4 * batch),
        epoch_num_steps=4 * batch,
        collection_step_num_env_steps=batch,
        update_step_num_repetitions=10,
        batch_size=512,
    )
)
torch.save(algorithm.state_dict(), "tianshou_ppo.pt")
envs.close()
