"""Time of a decision of an exported policy, in ONNX Runtime on one thread: with the map of what was seen, and without.

Each policy is exported, and drives in the maze in Warp with the starts and goals of a seed. The time is that of the
call alone.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.table import Table
from tensordict import TensorDictBase

from benchmarks.options import Options
from benchmarks.told import told
from rover_rl import RoverEnv
from rover_rl.algos.deploy.export import OnnxPolicy, export
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.algos.pretrained import load_pretrained

POLICIES = {"anywhere": "with the map", "moon-ppo": "without"}
"""Pretrained policies, and whether they keep a map."""


class Timed:
    """Policy that keeps the durations of its decisions, ms."""

    row_by_row = True

    def __init__(self, policy: OnnxPolicy) -> None:
        self._policy, self.durations = policy, list[float]()
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        self.made_for, self.trained_action_repeat = policy.made_for, policy.trained_action_repeat

    def __call__(self, observation: TensorDictBase) -> TensorDictBase:
        begin = time.perf_counter()
        decided = self._policy(observation)
        self.durations.append(1000 * (time.perf_counter() - begin))
        return decided


def measure(options: Options) -> list[dict[str, Any]]:
    """Measures each policy. Returns a row for each."""
    return [
        told(f"decisions of {name}, {what}", partial(_measure, name, options.decisions))
        for name, what in POLICIES.items()
    ]


def _measure(name: str, decisions: int) -> dict[str, Any]:
    """Drives from goal to goal for a number of decisions."""
    checkpoint = load_pretrained(name)
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.onnx"
        export(checkpoint, path)
        policy = Timed(OnnxPolicy(path))
    env = RoverEnv(replace(checkpoint.env, world="maze", backend="warp", num_envs=1, seed=0))
    runner, observation = PolicyRunner(policy, env=env), env.reset()
    while len(policy.durations) < decisions:
        _, observation = env.step_and_maybe_reset(observation.set("action", runner(observation)))
        runner.reset(observation["done"].squeeze(-1))
    env.close()
    median, p95 = np.percentile(policy.durations, (50, 95)).tolist()
    return {"policy": name, "decisions": decisions, "median_ms": median, "p95_ms": p95}


def table(rows: list[dict[str, Any]]) -> Table:
    """Formats the rows for the terminal."""
    table = Table("policy", "decisions", "median, ms", "95th percentile, ms", title="A decision in ONNX Runtime")
    for row in rows:
        figures = f"{row['median_ms']:.1f}", f"{row['p95_ms']:.1f}"
        table.add_row(f"{row['policy']}, {POLICIES[row['policy']]}", str(row["decisions"]), *figures)
    return table
