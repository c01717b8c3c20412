"""Speed of PPO's whole loop on the device, and what the wall-clock time is spent on."""

from __future__ import annotations

from contextlib import closing
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import torch
from rich.table import Table
from tensordict import TensorDictBase

from benchmarks.gpu.kernels import KERNELS
from benchmarks.gpu.timing import Phase, profiled
from benchmarks.options import Options
from rover_rl.algos.config import UNLIMITED_STEPS, TrainingConfig, training_config, with_settings
from rover_rl.algos.train.ppo import PPOLearner
from rover_rl.algos.train.run import TrainingRun, prepare

BATCHES = 3  # number of batches before the measurement, and of measured ones
SIMULATION = tuple(KERNELS)  # beginnings of the names of the package's kernels, as a profiler shows them
MINIBATCHES = 4  # number of minibatches that a batch is divided into
LEAST_MINIBATCH = 2048  # least number of decisions of a minibatch


def measure(options: Options, device: torch.device, _: dict[str, Any]) -> list[dict[str, Any]]:
    """Measures PPO with each number of rovers, without a map and with one."""
    rows = []
    for rovers in options.gpu_learners:
        for with_map in (False, True):
            case = {"rovers": rovers, "map": with_map}
            try:
                with TemporaryDirectory() as folder:
                    rows.append(case | _measure(_config(options, device, rovers, with_map, Path(folder)), device))
            except RuntimeError as error:
                rows.append(case | {"error": str(error).splitlines()[0]})
    return rows


def _config(options: Options, device: torch.device, rovers: int, with_map: bool, folder: Path) -> TrainingConfig:
    base = training_config("ppo", backend="warp", device=str(device), world=options.gpu_worlds[0], seed=0)
    if with_map:
        base = with_settings(base, observation=("lidar", "imu", "target", "velocities", "route"), prior="route")
    size = max(LEAST_MINIBATCH, rovers * base.algorithm.rollout_length // MINIBATCHES)
    return with_settings(
        base, num_envs=rovers, minibatch=size, workers=1, total_steps=UNLIMITED_STEPS, runs=str(folder), name="gpu"
    )


def _measure(config: TrainingConfig, device: torch.device) -> dict[str, Any]:
    """Trains for a few batches. The clock runs for the last ones; one more is profiled on a GPU."""
    config = prepare(config)
    learner = PPOLearner(config)
    with TrainingRun(config, learner) as run, closing(run.batches()) as batches:

        def update(batch: TensorDictBase) -> None:
            run.record(learner.update(batch, run.share, run.stopwatch))

        for batch in islice(batches, BATCHES):
            update(batch)
        steps, started = run.steps, perf_counter()
        for batch in islice(batches, BATCHES):
            update(batch)
        # A batch is recorded with values from the device, so that the device has finished.
        rate = (run.steps - steps) / (perf_counter() - started)
        shares = {}
        if device.type == "cuda":
            collected: list[TensorDictBase] = []
            collection = profiled(lambda: collected.append(next(batches)))
            shares = shares_of(collection, profiled(lambda: update(collected[0])))
    return {"steps_per_s": rate, "minibatch": config.algorithm.minibatch, "clock": run.stopwatch.shares(), **shares}


def shares_of(collection: Phase, update: Phase) -> dict[str, float]:
    """Shares of the wall-clock time of a batch, by what the device does in its collection and the networks' update."""
    wall = collection.wall + update.wall
    simulation = sum(seconds for name, seconds in collection.kernels if name.startswith(SIMULATION))
    spent = {
        "simulation": simulation,
        "task and policy": sum(seconds for _, seconds in collection.kernels) - simulation,
        "update": sum(seconds for _, seconds in update.kernels),
    }
    shares = {f"device: {kind}": seconds / wall for kind, seconds in spent.items()}
    return shares | {"device: idle": 1 - sum(shares.values())}


def table(rows: list[dict[str, Any]]) -> Table:
    shares = sorted({key for row in rows for key in row if key.startswith("device: ")})
    table = Table("rovers", "map", "minibatch", "steps/s", *shares, title="PPO, whole loop")
    for row in rows:
        case = f"{row['rovers']:,}", "yes" if row["map"] else "no"
        if "error" in row:
            table.add_row(*case, "", row["error"])
            continue
        measured = f"{row['minibatch']:,}", f"{row['steps_per_s']:,.0f}"
        table.add_row(*case, *measured, *(f"{row[key]:.0%}" if key in row else "" for key in shares))
    return table
