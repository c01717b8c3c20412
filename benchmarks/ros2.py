"""Success, latency and CPU usage of the ROS 2 backend, compared with Bullet in process.

    python -m benchmarks.ros2 --policy anywhere

Starts ``rover-rl robot`` in a separate process, on the loopback interface and a random domain, and drives it through
``backend="ros2"``. Measures:

- success on the stored episodes, with the robot faster than real time, compared with ``backend="bullet"``;
- at 20 Hz, the time from the arrival of a scan to the command in the steps in which the policy decides;
- at 20 Hz, the CPU usage of the backend alone: sending commands and receiving messages, without environment and policy.

Writes the results to ``runs/ros2/ros2.json``. Requires ``pip install "rover_rl[ros2]"``.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table
from torchrl.envs.utils import ExplorationType, set_exploration_type

from benchmarks.stored import stored_worlds
from rover_rl import RoverEnv
from rover_rl.algos.evaluation.episodes import stored_episodes
from rover_rl.algos.evaluation.evaluate import Policy, environment_for, evaluate
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import single_threaded
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.algos.pretrained import load_pretrained, pretrained_names
from rover_rl.files import write_json
from rover_rl.robots import get_robot
from rover_rl.sims import make_simulator
from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.worlds import get_world

LIVE = Ros2Settings(reset="topic")


@dataclass
class Options:
    """Measure success, latency and CPU usage of the ROS 2 backend."""

    policy: str = "anywhere"
    """Name of a pretrained policy, or path of a checkpoint or of a run's folder. It drives in the first world
    with stored episodes that it was trained for."""
    count: int = 256
    """Number of stored episodes."""
    rate: float = 8.0
    """Simulation speed of the robot during the episodes, as a multiple of real time."""
    seconds: float = 60.0
    """Duration of the latency measurement and of the CPU measurement, s."""
    out: Path = Path("runs/ros2")
    """Output folder."""


@contextmanager
def robot(world: str, rate: float) -> Iterator[None]:
    """Runs ``rover-rl robot`` during the context."""
    command = [str(Path(sys.executable).with_name("rover-rl")), "robot", "--world", world, "--rate", str(rate)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        if "on ROS 2" not in process.stdout.readline():
            raise RuntimeError("the robot did not start")
        yield
    finally:
        process.terminate()
        process.wait()


def success(policy: Policy, world: str, options: Options) -> dict[str, Any]:
    """Measures success on both backends."""
    episodes = stored_episodes(world).first(options.count)
    bullet = evaluate(policy, episodes)
    with robot(world, options.rate):
        ros2 = evaluate(policy, episodes, rows=1, env=replace(environment_for(policy, None), backend=LIVE))
    return {
        "episodes": len(episodes.start),
        "success, bullet": bullet.success_rate,
        "success, ros2": ros2.success_rate,
        "difference": ros2.success_rate - bullet.success_rate,
        "SPL, bullet": bullet.metrics["spl"].value,
        "SPL, ros2": ros2.metrics["spl"].value,
    }


@single_threaded()
def latency(policy: Policy, world: str, seconds: float) -> dict[str, Any]:
    """Measures the latency of decisions, from the arrival of a scan to the command, ms, and the whole process's CPU."""
    latencies = []
    with robot(world, 1.0):
        env = RoverEnv(replace(environment_for(policy, None), world=world, backend=LIVE, seed=0))
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            td, runner, step = env.reset(), PolicyRunner(policy, env=env), 0
            wall, cpu = time.perf_counter(), time.process_time()
            while time.perf_counter() - wall < seconds:
                td = env.step(td.set("action", runner(td)))["next"]
                done = bool(td["done"].any())
                if step % runner.action_repeat == 0 and not done:
                    latencies.append(1000 * env.simulator.latency)
                step += 1
                if done:
                    td, step = env.reset(), 0
                    runner.reset()
            share = (time.process_time() - cpu) / (time.perf_counter() - wall)
        env.close()
    median, p99 = np.percentile(latencies, [50, 99])
    return {"latency, ms: median": median, "latency, ms: 99 %": p99, "CPU, all": share, "decisions": len(latencies)}


def backend_cpu(world: str, seconds: float) -> dict[str, Any]:
    """Measures the CPU usage of the backend alone, as a share of a core."""
    with robot(world, 1.0):
        simulator = make_simulator(LIVE, worlds=[get_world(world)], robot=get_robot("rover_zero"))
        simulator.step(torch.zeros(1, 2))
        wall, cpu = time.perf_counter(), time.process_time()
        while time.perf_counter() - wall < seconds:
            simulator.step(torch.tensor([[0.1, 0.2]]))
        share = (time.process_time() - cpu) / (time.perf_counter() - wall)
        simulator.close()
    return {"CPU, backend": share}


def main(options: Options) -> None:
    """Runs all measurements, writes the results and prints a table."""
    os.environ |= {"ROS_DOMAIN_ID": str(random.SystemRandom().randint(1, 99)), "ROS_LOCALHOST_ONLY": "1"}
    name = options.policy
    checkpoint = load_pretrained(name) if name in pretrained_names() else Checkpoint.load(name)
    policy, world = checkpoint.make_actor(), stored_worlds(checkpoint.env)[0]
    results = latency(policy, world, options.seconds) | backend_cpu(world, options.seconds)
    results |= success(policy, world, options)
    write_json(options.out / "ros2.json", {"policy": name, "rate": options.rate, **results})
    table = Table("", name)
    for name, value in results.items():
        table.add_row(name, f"{value:,}" if isinstance(value, int) else f"{value:.3f}")
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
