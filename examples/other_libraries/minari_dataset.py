"""A data set of the planner ``gridplanner`` for Minari. It needs ``minari`` with its extras ``create`` and ``hdf5``."""

import gymnasium
import minari
import torch
from tensordict import TensorDict

import rover_rl
from rover_rl.algos.policy.names import make_baseline
from rover_rl.algos.policy.runner import PolicyRunner

EPISODES = 20
DATASET = "rover_rl/gridplanner-inspect-v0"

env = gymnasium.make(
    rover_rl.ENV_ID,
    world_n="inspect",
    sensors=["route(period=4)"],
    length=600,
    end_on_goal=True,
    time_limit="truncated",
)
collector = minari.DataCollector(env)
rover = env.unwrapped.base_env
planner = PolicyRunner(make_baseline("gridplanner"), env=rover)

reached = 0
for episode in range(EPISODES):
    observation, _ = collector.reset(seed=episode)
    planner.reset()
    ended = False
    while not ended:
        now = TensorDict({key: torch.from_numpy(value)[None] for key, value in observation.items()}, [1])
        action = planner(now)[0].numpy()
        observation, _, terminated, truncated, info = collector.step(action)
        ended = terminated or truncated
    reached += info["is_success"]
dataset = collector.create_dataset(
    DATASET, algorithm_name="gridplanner", description="Drives of the grid planner between the boxes of inspect."
)
print(f"{dataset.total_episodes} episodes, {dataset.total_steps} steps, {reached} goals")
print({key: value.shape for key, value in dataset[0].observations.items()})
