"""Speed of batched rollouts, and the share of the time spent in Bullet.

The benchmark calls ``step_and_maybe_reset`` with random actions and the contract's reward. It reports medians over the
steps without resets: the time in Bullet's ``stepSimulation`` and ``rayTestBatch``, and the rest (state and motor calls
of PyBullet, task, rewards, TorchRL).
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import torch
from rich.table import Table
from torch.profiler import ProfilerActivity, profile
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from benchmarks.options import Options
from benchmarks.ratios import rate, told
from rover_rl import make_env
from rover_rl.native.bullet import pybullet

ROLLOUT_LENGTH = 16  # number of steps of each rover in a batch
WARM_UP = 3  # number of initial steps that are not measured


@contextmanager
def rollouts(world: str, rovers: int, beams: int, workers: int) -> Iterator[Callable[[], int]]:
    """Opens a collector, and gives a function that collects a batch of steps of all rovers and returns their number."""
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


@dataclass(frozen=True)
class Row:
    """Results of one environment: steps per second of one process, and of all workers if they share the rovers equally.

    ``physics`` and ``rays`` are the times in ``stepSimulation`` and ``rayTestBatch`` per rover and step, ``rest`` is
    the remaining time per batched step, us. ``operators`` is the number of PyTorch operators of a step in which all
    rovers reset: on a GPU, the host would launch most of them one by one.
    """

    num_envs: int
    beams: int
    steps_per_s: float
    all_workers: float | None
    physics: float
    rays: float
    rest: float
    operators: float

    @property
    def share(self) -> float:
        return self.rest / (self.rest + self.num_envs * (self.physics + self.rays))


class Stopwatch:
    """Wraps a function and accumulates the time of its calls."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.seconds, self._function = 0.0, function

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        start = time.perf_counter()
        result = self._function(*args, **kwargs)
        self.seconds += time.perf_counter() - start
        return result

    def take(self) -> float:
        seconds, self.seconds = self.seconds, 0.0
        return seconds


@contextmanager
def timed_pybullet(*names: str) -> Iterator[list[Stopwatch]]:
    """Replaces functions of PyBullet by stopwatches."""
    functions = {name: getattr(pybullet, name) for name in names}
    watches = [Stopwatch(function) for function in functions.values()]
    try:
        for name, watch in zip(names, watches, strict=True):
            setattr(pybullet, name, watch)
        yield watches
    finally:
        for name, function in functions.items():
            setattr(pybullet, name, function)


def time_rollout(env: EnvBase, seconds: float) -> dict[str, float]:
    """Steps an environment with random actions for about ``seconds``. Returns speed and times as in :class:`Row`."""
    count = env.batch_size[0]
    actions = [env.action_spec.rand() for _ in range(16)]
    td = env.reset()
    times: list[tuple[float, float, float]] = []
    total = steps = 0.0
    with timed_pybullet("stepSimulation", "rayTestBatch") as watches:
        begin, number = time.perf_counter(), 0
        while time.perf_counter() - begin < seconds or len(times) < 5:
            td.set("action", actions[number % 16])
            for watch in watches:
                watch.take()
            start = time.perf_counter()
            result, td = env.step_and_maybe_reset(td)
            elapsed = time.perf_counter() - start
            physics, rays = (watch.take() for watch in watches)
            number += 1
            if number <= WARM_UP:
                continue
            steps, total = steps + count, total + elapsed
            if not result["next", "done"].any() or number > 500:
                times.append((physics / count, rays / count, elapsed - physics - rays))
    physics, rays, rest = (statistics.median(column) * 1e6 for column in zip(*times, strict=True))
    return {"steps_per_s": steps / total, "physics": physics, "rays": rays, "rest": rest}


def count_operators(env: EnvBase, steps: int = 5) -> float:
    """Counts the PyTorch operators of a step in which all rovers reset, without those that operators call."""
    length, env.base_env.length = env.base_env.length, 1
    td = env.reset()
    with profile(activities=[ProfilerActivity.CPU]) as profiler:
        for _ in range(steps):
            _, td = env.step_and_maybe_reset(td.set("action", env.action_spec.zero()))
    env.base_env.length = length
    return sum(event.cpu_parent is None and event.name.startswith("aten::") for event in profiler.events()) / steps


def measure(options: Options) -> list[dict[str, Any]]:
    """Measures each number of beams and rovers. Returns a row for each."""
    return [
        told(f"{num_envs:,} rovers, {beams} beams", partial(_measure, options, beams, num_envs))
        for beams in options.beams
        for num_envs in options.num_envs
    ]


def _measure(options: Options, beams: int, num_envs: int) -> dict[str, Any]:
    env = make_worker_env(options.world, num_envs, beams, 0)
    times = time_rollout(env, options.seconds) | {"operators": count_operators(env)}
    env.close()
    shared = None
    if options.workers > 1 and num_envs % options.workers == 0:
        with rollouts(options.world, num_envs, beams, options.workers) as batch:
            batch()
            shared = rate(batch, options.seconds)
    return asdict(Row(num_envs=num_envs, beams=beams, all_workers=shared, **times))


def table(rows: list[dict[str, Any]]) -> Table:
    times = "us/rover: physics", "rays", "us/batch: rest", "share"
    table = Table("rovers", "beams", "steps/s", "all workers", *times, "operators", title="Batched rollouts")
    for row in (Row(**row) for row in rows):
        table.add_row(
            f"{row.num_envs:,}",
            str(row.beams),
            f"{row.steps_per_s:,.0f}",
            "" if row.all_workers is None else f"{row.all_workers:,.0f}",
            f"{row.physics:,.0f}",
            f"{row.rays:,.0f}",
            f"{row.rest:,.0f}",
            f"{row.share:.1%}",
            f"{row.operators:,.0f}",
        )
    return table
