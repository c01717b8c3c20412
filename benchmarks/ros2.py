"""The rover on ROS 2 beside the same rover in process: success, latency, and what it costs.

    python benchmarks/ros2.py --policy pretrained:maze-ppo

Starts ``rover-rl robot`` in a process of its own, on the loopback interface and a domain drawn at random, and drives it
through ``backend="ros2"``:

- success on the stored episodes, with the robot faster than real time, beside that of ``backend="bullet"``;
- at 20 Hz, the time from a scan's arrival to the command that answers it, with the policy in between;
- at 20 Hz, the CPU that the backend alone takes: commands sent, messages taken in, no environment, no policy.

Results are in ``runs/ros2/ros2.json``. Needs ``pip install "rover_rl[ros2]"``.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl import RoverEnv
from rover_rl.algos.evaluation.episodes import stored_episodes
from rover_rl.algos.evaluation.evaluate import Policy, evaluate
from rover_rl.algos.policy.networks import single_threaded
from rover_rl.cli.policies import resolve_policy
from rover_rl.files import write_json
from rover_rl.sims import make_simulator
from rover_rl.sims.robots import get_robot
from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.sims.worlds import get_world

LIVE = Ros2Settings(reset="topic")


@dataclass
class Options:
    """What to measure."""

    policy: str = "pretrained:maze-ppo"
    """Folder of a run, a checkpoint, an ONNX file, or pretrained:NAME."""
    count: int = 256
    """Stored episodes to drive."""
    rate: float = 8.0
    """Times as fast as real time that the robot runs while they are driven."""
    seconds: float = 60.0
    """To measure latency and CPU for, each."""
    out: Path = Path("runs/ros2")
    """Folder to write to."""


@contextmanager
def robot(world: str, rate: float) -> Iterator[None]:
    """``rover-rl robot`` while it lasts."""
    command = [str(Path(sys.executable).with_name("rover-rl")), "robot", "--world", world, "--rate", str(rate)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        if "on ROS 2" not in process.stdout.readline():
            raise RuntimeError("the robot did not come up")
        yield
    finally:
        process.terminate()
        process.wait()


def success(policy: Policy, world: str, options: Options) -> dict[str, Any]:
    """Success on both backends."""
    episodes = stored_episodes(world).first(options.count)
    here = evaluate(policy, episodes)
    with robot(world, options.rate):
        there = evaluate(policy, episodes, rows=1, backend=LIVE)
    return {
        "episodes": len(episodes.start),
        "success, bullet": here.success_rate,
        "success, ros2": there.success_rate,
        "difference": there.success_rate - here.success_rate,
        "SPL, bullet": here.metrics["spl"].value,
        "SPL, ros2": there.metrics["spl"].value,
    }


@single_threaded()
def latency(policy: Policy, world: str, seconds: float) -> dict[str, Any]:
    """From a scan's arrival to the command that answers it, ms, and the CPU of it all."""
    waits = []
    with robot(world, 1.0):
        env = RoverEnv(world_n=world, backend=LIVE, seed=0)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            now = env.reset()
            wall, cpu = time.perf_counter(), time.process_time()
            while time.perf_counter() - wall < seconds:
                now = env.step(policy(now))["next"]
                waits.append(1000 * env.simulator.latency)
                if now["done"].any():
                    now, waits = env.reset(), waits[:-1]
            share = (time.process_time() - cpu) / (time.perf_counter() - wall)
        env.close()
    median, late = np.percentile(waits, [50, 99])
    return {"latency, ms: median": median, "latency, ms: 99 %": late, "CPU, all": share, "steps": len(waits)}


def backend_cpu(world: str, seconds: float) -> dict[str, Any]:
    """CPU of the backend alone, as a share of a core."""
    with robot(world, 1.0):
        simulator = make_simulator(LIVE, worlds=[get_world(world)], robot=get_robot("rover_zero"), lidar_beams=128)
        simulator.step(torch.zeros(1, 2))
        wall, cpu = time.perf_counter(), time.process_time()
        while time.perf_counter() - wall < seconds:
            simulator.step(torch.tensor([[0.1, 0.2]]))
        share = (time.process_time() - cpu) / (time.perf_counter() - wall)
        simulator.close()
    return {"CPU, backend": share}


def main(options: Options) -> None:
    """Measures, and shows."""
    os.environ |= {"ROS_DOMAIN_ID": str(random.SystemRandom().randint(1, 99)), "ROS_LOCALHOST_ONLY": "1"}
    driver = resolve_policy(options.policy, ())
    if driver.policy is None or not driver.worlds:
        raise SystemExit(f"{options.policy} is no trained policy")
    world = driver.worlds[0]
    results = latency(driver.policy, world, options.seconds) | backend_cpu(world, options.seconds)
    results |= success(driver.policy, world, options)
    write_json(options.out / "ros2.json", {"policy": options.policy, "rate": options.rate, **results})
    table = Table("", options.policy)
    for name, value in results.items():
        table.add_row(name, f"{value:,}" if isinstance(value, int) else f"{value:.3f}")
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
