"""Rollouts as in training: a TorchRL collector with a batch of rovers in each worker, with random actions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import torch
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from rover_rl import make_env

ROLLOUT_LENGTH = 16
"""Number of steps of each rover in a batch, as in PPO."""


@contextmanager
def rollouts(world: str, rovers: int, beams: int, workers: int) -> Iterator[Callable[[], int]]:
    """Opens a collector; a context manager that gives a function.

    The function collects a batch of ``ROLLOUT_LENGTH`` steps of all rovers and returns their number.
    """
    each = rovers // workers
    makers = [partial(make_worker_env, world, each, beams, worker * each) for worker in range(workers)]
    common = {"frames_per_batch": rovers * ROLLOUT_LENGTH, "auto_register_policy_transforms": False}
    if workers == 1:
        collector = Collector(makers[0], None, track_traj_ids=False, **common)
    else:
        collector = Collector(
            makers, None, num_collectors=workers, sync=True, cat_results=0, use_buffers=True, num_threads=1, **common
        )
    batches = iter(collector)
    try:
        yield lambda: next(batches).numel()
    finally:
        collector.shutdown()


def make_worker_env(world: str, rovers: int, beams: int, seed: int) -> EnvBase:
    torch.set_num_threads(1)
    return make_env(world_n=world, num_envs=rovers, lidar_beams=beams, seed=seed)
