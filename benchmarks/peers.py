"""Speed compared with common setups: a process and a PyBullet client for each rover, with equal physics and beams."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import psutil
import torch
from rich.table import Table
from stable_baselines3.common.vec_env import SubprocVecEnv
from torchrl.envs import GymWrapper as TorchRLGymWrapper
from torchrl.envs import ParallelEnv

from benchmarks.options import Options
from benchmarks.plain_rover import PlainRover
from benchmarks.ratios import paired, told
from benchmarks.rollouts import rollouts

BEAMS = 128
PROCESS_BYTES = 2**28  # memory of a process of a peer, bytes. Measurements that do not fit into memory are skipped.


@contextmanager
def async_vector_env(world: str, count: int) -> Iterator[Callable[[], int]]:
    """Gymnasium's AsyncVectorEnv, with shared memory."""
    makers = [partial(make_rover, world)] * count
    yield from _stepped(gymnasium.vector.AsyncVectorEnv(makers, context="forkserver"), count)


@contextmanager
def subproc_vec_env(world: str, count: int) -> Iterator[Callable[[], int]]:
    """Stable-Baselines3's SubprocVecEnv."""
    yield from _stepped(SubprocVecEnv([partial(make_rover, world)] * count, start_method="forkserver"), count)


def _stepped(envs: gymnasium.vector.VectorEnv | SubprocVecEnv, count: int) -> Iterator[Callable[[], int]]:
    envs.reset()
    actions = _actions(count)

    def step() -> int:
        envs.step(next(actions))
        return count

    try:
        yield step
    finally:
        envs.close()


@contextmanager
def parallel_env(world: str, count: int) -> Iterator[Callable[[], int]]:
    """TorchRL's ParallelEnv over a Gymnasium environment."""
    envs = ParallelEnv(count, partial(make_torchrl_rover, world), mp_start_method="forkserver")
    now = envs.reset()
    actions = _actions(count)

    def step() -> int:
        nonlocal now
        now = envs.step_and_maybe_reset(now.set("action", torch.from_numpy(next(actions))))[1]
        return count

    try:
        yield step
    finally:
        envs.close()


PEERS = {
    "Gymnasium's AsyncVectorEnv": async_vector_env,
    "Stable-Baselines3's SubprocVecEnv": subproc_vec_env,
    "TorchRL's ParallelEnv": parallel_env,
}


def make_rover(world: str) -> PlainRover:
    torch.set_num_threads(1)
    return PlainRover(world, BEAMS)


def make_torchrl_rover(world: str) -> TorchRLGymWrapper:
    return TorchRLGymWrapper(make_rover(world))


def _actions(count: int) -> Iterator[np.ndarray]:
    random = np.random.default_rng(0)
    drawn = random.uniform((-1, -np.pi), (1, np.pi), (16, count, 2)).astype(np.float32)
    while True:
        yield from drawn


def measure(options: Options) -> list[dict[str, Any]]:
    """Measures rollouts with all workers alternately with each peer and number of processes. Returns a row for each."""
    # Imported once and shared by all processes.
    multiprocessing.set_forkserver_preload([__name__])
    counts = options.processes or sorted({4 * options.workers, options.rovers})
    rows = []
    with rollouts(options.world, options.rovers, BEAMS, options.workers) as ours:
        for name, peer in PEERS.items():
            for count in counts:
                if count * PROCESS_BYTES > psutil.virtual_memory().available:
                    rows.append({"peer": name, "processes": count})
                    continue
                with peer(options.world, count) as theirs:
                    measure = partial(paired, ours, theirs, options.seconds, options.rounds)
                    ratio = told(f"{name}, {count} processes", measure)
                rows.append({"peer": name, "processes": count, **asdict(ratio)})
    return rows


def table(rows: list[dict[str, Any]]) -> Table:
    headings = "peer", "processes", "steps/s of the peer", "rover_rl", "ratio"
    table = Table(*headings, title="Compared with a process for each rover")
    for row in rows:
        case = row["peer"], str(row["processes"])
        if "median" not in row:
            table.add_row(*case, "not enough memory")
            continue
        ratio = f"{row['median']:.2f} ({row['least']:.2f} to {row['most']:.2f})"
        table.add_row(*case, f"{row['other']:,.0f}", f"{row['rate']:,.0f}", ratio)
    return table
