"""Policies with memory for tests."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase

from rover_rl.algos.config import training_config
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import make_actor


def observations(rows: int, steps: int = 12) -> list[TensorDict]:
    """Random observations ``[rows]`` of some steps. Those of a row do not depend on the number of rows."""
    generators = [torch.Generator().manual_seed(row) for row in range(rows)]
    sizes = {"lidar": 32, "imu": 3, "target": 2, "velocities": 2}

    def drawn(size: int) -> torch.Tensor:
        return torch.stack([torch.rand(size, generator=generator) for generator in generators])

    return [TensorDict({key: drawn(size) for key, size in sizes.items()}, batch_size=[rows]) for _ in range(steps)]


class CountingPolicy:
    """Counts its decisions: its speed is a hundredth of the number of earlier decisions in the episode."""

    in_keys = ("target", "count", "is_init")
    out_keys = ("action", ("next", "count"))
    trained_action_repeat = 4

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, td: TensorDictBase) -> TensorDictBase:
        self.calls += 1
        zeros = torch.zeros(len(td), 1)
        count = torch.where(td["is_init"], zeros, td.get("count", zeros))
        td["action"] = torch.cat((count / 100, zeros), -1)
        return td.set(("next", "count"), count + 1)


def recurrent_checkpoint(scale: float = 2.0) -> Checkpoint:
    """A checkpoint of a small network with memory and random weights, enlarged so that its actions differ."""
    config = training_config("ppo", world="maze", hidden=(16, 8), memory="gru", memory_size=12)
    torch.manual_seed(0)
    actor = make_actor(hidden=(16, 8), memory="gru", memory_size=12)
    weights = {name: weight * scale for name, weight in actor.state_dict().items()}
    return Checkpoint(config=config, steps=100, actor=weights)
