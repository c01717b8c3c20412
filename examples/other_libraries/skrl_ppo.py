"""PPO of skrl learns a task on a batch of rovers: ``pip install skrl``."""

import sys

import gymnasium
import torch
from skrl.envs.wrappers.torch import wrap_env
from skrl.utils import set_seed
from skrl.utils.runner.torch import Runner

from rover_rl import get_task  # the package registers the environments

TASK, SEED, DECISIONS = sys.argv[1:4] if len(sys.argv) > 3 else ("inspect", 0, 500_000)  # decisions of 4 steps
ROVERS = 256

torch.set_num_threads(1)  # small networks do not gain from more threads
set_seed(int(SEED))
envs = wrap_env(
    gymnasium.make_vec(
        get_task(TASK).gym_id,
        num_envs=ROVERS,
        vectorization_mode="vector_entry_point",
        autoreset_mode="SameStep",
        seed=int(SEED),
    )
)
network = [{"name": "net", "input": "OBSERVATIONS", "layers": [128, 128], "activations": "elu"}]
policy = {"class": "GaussianMixin", "network": network, "output": "ACTIONS", "initial_log_std": 0.0}
value = {"class": "DeterministicMixin", "network": network, "output": "ONE"}
settings = {
    "models": {"separate": True, "policy": {**policy, "clip_actions": True}, "value": value},
    "memory": {"class": "RandomMemory", "memory_size": -1},
    "agent": {
        "class": "PPO",
        "rollouts": 32,
        "mini_batches": 4,
        "learning_rate": 3e-4,
        "time_limit_bootstrap": True,
        "experiment": {"directory": "runs/skrl", "write_interval": 100, "checkpoint_interval": 0},
    },
    "trainer": {"class": "SequentialTrainer", "timesteps": int(DECISIONS) // ROVERS, "headless": True},
    "seed": int(SEED),
}
runner = Runner(envs, settings)
runner.run()
runner.agent.save("skrl_ppo.pt")
envs.close()
