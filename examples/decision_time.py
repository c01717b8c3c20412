"""
How long a decision takes
=========================

Times decisions of the shipped policies for one rover, on one core: in PyTorch, and as the ONNX files that robots run.
The routes, tracks and images that they read are computed before, and are not part of it. Other policies are arguments:
``python examples/decision_time.py runs/ppo-gru-mazes``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import torch
from tensordict import TensorDict

from rover_rl.algos.deploy.export import OnnxPolicy, export, random_observations
from rover_rl.algos.policy.names import PRETRAINED, load_policy
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.algos.pretrained import pretrained_names
from rover_rl.envs.sensors.robot import robot_table
from rover_rl.robots import get_robot

DECISIONS = 300
ROBOT = get_robot("jackal")  # what a policy for several robots drives


def milliseconds(decide: Callable[[TensorDict], Any], observation: TensorDict) -> float:
    """Median time of a decision, ms."""
    times = []
    for _ in range(DECISIONS):
        begin = perf_counter()
        decide(observation)
        times.append(perf_counter() - begin)
    return 1e3 * median(times)


torch.set_num_threads(1)
print(f"{'policy':<28}{'PyTorch, ms':>12}{'ONNX, ms':>12}")
with torch.no_grad(), TemporaryDirectory() as folder:
    for name in sys.argv[1:] or [PRETRAINED + name for name in pretrained_names()]:
        checkpoint = load_policy(name)
        several = "robot" in checkpoint.config.network.observation
        if several:
            checkpoint = checkpoint.for_robot(ROBOT.name)
        export(checkpoint, file := Path(folder) / "policy.onnx")
        observation = TensorDict(random_observations(checkpoint, 1), [1])
        if several:
            observation["robot"] = robot_table([ROBOT])
        policies = checkpoint.make_actor(), OnnxPolicy(file)
        times = [milliseconds(PolicyRunner(policy, action_repeat=1), observation) for policy in policies]
        print(f"{name:<28}{times[0]:>12.2f}{times[1]:>12.2f}")
