"""Data collection in one process that never makes the host wait for a GPU.

TorchRL's collector reads values from the device in every step, for example whether any episode has ended. Each reading
waits until the GPU has finished all its work, so that the host cannot prepare the next step meanwhile. This loop reads
none on a GPU: it resets ended rows by mask in every step, whether there are any or not. The data is that of TorchRL's
collector, to the last bit.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor


@runtime_checkable
class PerBatch(Protocol):
    """Transform that reads values from the device once per batch, instead of once per step."""

    def batch_collected(self, batch: TensorDictBase) -> None:
        """Reads what it needs after a batch ``[N, T]`` is collected. It may wait for the device."""
        ...


def rollouts(env: TransformedEnv, actor: ProbabilisticActor, length: int) -> Iterator[TensorDictBase]:
    """Yields endless batches ``[N, length]`` of consecutive steps, in which the actor explores."""
    per_batch = [transform for transform in env.transform if isinstance(transform, PerBatch)]
    current = env.reset()
    while True:
        steps = []
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            for _ in range(length):
                step = env.step(actor(current))
                steps.append(step)
                current = _with_new_episodes(env, env.step_mdp(step))
            batch = torch.stack(steps, -1)
        for transform in per_batch:
            transform.batch_collected(batch)
        yield batch


def _with_new_episodes(env: TransformedEnv, current: TensorDictBase) -> TensorDictBase:
    """Returns the data ``[N]`` before the next step: that of new episodes in rows whose episode has ended.

    ``EnvBase.reset`` would check the values of the mask and of the new data.
    """
    ended = current["done"]
    # On the CPU this check is cheap and saves most resets.
    if ended.device.type == "cpu" and not ended.any():
        return current
    begun = env._reset(TensorDict({"_reset": ended}, current.batch_size, device=current.device))
    # The actor's outputs are left out: it writes them again.
    kept = current.select(*begun.keys())
    return kept.where(~ended.reshape(current.batch_size), begun, pad=0)
