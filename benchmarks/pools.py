"""Speed of Warp with many worlds or robots in a batch, and with another one for each episode.

    python -m benchmarks.pools --num-envs 1024
    python -m benchmarks.pools --parts robots

Measures environments side by side, in turn: all rows in one maze, rows in many mazes for life, and rows that draw
another maze for each episode. Prints the steps per second of each, and their ratio to all rows in one maze in the same
round. As mazes differ, the latter is the mean over several of them. First prints the time that a world takes to
prepare, its layout, its free space, and its copy on the device, when nothing is on disk and when all is, and the memory
of the process with many worlds. The cache on disk is empty at first. Then measures a batch of different robots in the
same way, compared with the mean over batches of one of these robots each.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise, product
from statistics import harmonic_mean, median
from tempfile import TemporaryDirectory
from typing import Any, Literal
from unittest.mock import patch

import torch
import tyro
from psutil import Process
from rich.console import Console
from rich.table import Table
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from rover_rl import RoverEnv, make_env
from rover_rl.envs.config import RobotLike
from rover_rl.robots import Robot, get_robot, get_robots
from rover_rl.sims.free_space import free_space
from rover_rl.sims.free_space.fitting import passage_scale
from rover_rl.sims.scenes.table import SceneTable
from rover_rl.sims.warp import WarpSettings
from rover_rl.worlds import _make_world, get_world
from rover_rl.worlds.pool import WorldPool


@dataclass
class Options:
    """Options of the measurement."""

    parts: tuple[Literal["worlds", "robots"], ...] = ("worlds", "robots")
    """What to measure."""
    num_envs: int = 1024
    """Number of rovers."""
    worlds: int = 1024
    """Number of mazes that rows are in for life."""
    singles: int = 4
    """Number of mazes that all rows are in, and of robots that all rows have, one after the other."""
    pool: str = "maze:*"
    """Mazes that episodes draw from."""
    robots: str = "any:0-63"
    """Robots that episodes draw from."""
    warm: bool = False
    """Whether all mazes of the pool are on disk at first, as after a long run. Takes minutes."""
    length: int = 400
    """Number of steps after which an episode ends."""
    settle: int = 200
    """Number of steps before the first round. In them, a thread prepares a world for the next episode of each row."""
    steps: int = 50
    """Number of steps measured in each round."""
    rounds: int = 3
    """Number of rounds."""
    threads: int = 1
    """Number of CPU threads."""
    generators: tuple[str, ...] = ("maze", "forest", "rooms")
    """Generators whose preparation is timed."""
    prepared: int = 20
    """Number of worlds prepared of each."""


def preparation(options: Options) -> Table:
    """Measures the processor time for preparing worlds."""
    table = Table("generator", "on disk", "layout", "free space", "copy", "all", title="Preparation of a world, ms")
    robot = get_robot("rover_zero")
    # The first world compiles the kernels.
    _prepare("moon", robot, SceneTable(1, 0.5, "cpu"))
    for name, stored in product(options.generators, ("", "yes")):
        # In memory, a world is found by its name.
        _make_world.cache_clear()
        scenes = SceneTable(1, 0.5, "cpu")
        times = [_prepare(f"{name}:{5000 + seed}", robot, scenes) for seed in range(options.prepared)]
        table.add_row(name, stored, *(f"{median(part):.2f}" for part in zip(*times, strict=True)))
    return table


def _prepare(name: str, robot: Robot, scenes: SceneTable) -> tuple[float, ...]:
    """Prepares a world and returns the times for its layout, its free space, its copy, and all of them, ms."""
    clock = [time.process_time()]
    world = get_world(name)
    clock.append(time.process_time())
    free_space(world, robot)
    clock.append(time.process_time())
    scenes[0] = world
    clock.append(time.process_time())
    return tuple(1e3 * (end - begin) for begin, end in [*pairwise(clock), (clock[0], clock[-1])])


def memory(options: Options) -> str:
    """Measures the memory of this process before and after building an environment with a world for each row."""
    process = Process()
    before = process.memory_info().rss
    mazes = [f"maze:{20_000 + seed}" for seed in range(options.worlds)]
    env = make_env(world_n=mazes, num_envs=len(mazes), backend="warp", seed=0)
    env.rollout(2)
    after = process.memory_info().rss
    return f"Memory with {len(mazes)} mazes: {after / 2**20:,.0f} MB in all, {before / 2**20:,.0f} MB before"


def warm_up(options: Options) -> None:
    """Prepares all mazes of the pool, so that they are on disk."""
    env = RoverEnv(world_n="maze", backend="warp")
    for world in WorldPool(options.pool):
        free_space(world, env.robot)
        env.simulator.prepare_world(world)


def speeds(options: Options) -> Table:
    """Measures environments with different worlds side by side."""
    mazes = [f"maze:{seed}" for seed in range(min(options.worlds, options.num_envs))]
    kinds = {
        **{f"one maze, {seed}": f"maze:{seed}" for seed in range(0, len(mazes), -(-len(mazes) // options.singles))},
        f"{len(mazes)} mazes": mazes,
        "another maze for each episode": options.pool,
    }
    return _compared({name: {"world_n": worlds} for name, worlds in kinds.items()}, options)


def robots(options: Options) -> Table:
    """Measures environments with different robots side by side, in one maze that has room for all of them."""
    family = get_robots(options.robots)
    widest = max(map(passage_scale, family))
    chosen = family[:: -(-len(family) // options.singles)]
    kinds: dict[str, RobotLike] = {
        **{f"one robot, {robot.name}": robot for robot in (*chosen, get_robot("rover_zero"))},
        f"{len(family)} robots, another one for each episode": options.robots,
    }
    return _compared(
        {name: {"robot": robot, "world_n": f"maze:0*{widest:g}"} for name, robot in kinds.items()}, options
    )


def _compared(kinds: Mapping[str, dict[str, Any]], options: Options) -> Table:
    """Measures environments with different settings, in turn. Those named "one ..." are what others are compared to."""
    settings = {"num_envs": options.num_envs, "backend": WarpSettings(threads=options.threads), "seed": 0}
    envs = {name: make_env(length=options.length, **settings, **own) for name, own in kinds.items()}
    results: dict[str, list[float]] = {name: [] for name in envs}
    # Episodes end all the time, and not all of them at once, after one episode of random length.
    states = {name: _spread(env, options) for name, env in envs.items()}
    for _ in range(options.rounds):
        for name, env in envs.items():
            states[name], rate = _drive(env, states[name], options.steps)
            results[name].append(rate)
    table = Table("environment", "steps/s", "ratio", title=f"{options.num_envs} rovers, {options.threads} threads")
    # The time of a step, averaged over the mazes or robots.
    single = [harmonic_mean(rates) for rates in zip(*(results[k] for k in results if k.startswith("one")), strict=True)]
    for name, rates in {"mean of one": single, **results}.items():
        ratio = median(rate / other for rate, other in zip(rates, single, strict=True))
        table.add_row(name, f"{min(rates):,.0f} to {max(rates):,.0f}", f"{ratio:.2f}")
    return table


def _spread(env: EnvBase, options: Options) -> TensorDictBase:
    """Drives until the ends of the episodes are spread over time."""
    td = env.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(4):
        td, _ = _drive(env, td, options.length // 20)
        mask = torch.rand(options.num_envs, 1, generator=generator) < 0.25
        td = env.reset(td.set("_reset", mask)).exclude("_reset")
    return _drive(env, td, options.settle)[0]


def _drive(env: EnvBase, td: TensorDictBase, steps: int) -> tuple[TensorDictBase, float]:
    """Drives with random actions and returns the last state and the number of steps of all rovers per second."""
    started = time.perf_counter()
    for _ in range(steps):
        _, td = env.step_and_maybe_reset(env.rand_action(td))
    return td, steps * env.batch_size[0] / (time.perf_counter() - started)


def main(options: Options) -> None:
    """Prints the tables."""
    torch.set_num_threads(options.threads)
    console = Console(width=110)
    with TemporaryDirectory() as folder, patch.dict(os.environ, XDG_CACHE_HOME=folder):
        if "worlds" in options.parts:
            console.print(preparation(options))
            console.print(memory(options))
            if options.warm:
                warm_up(options)
            console.print(speeds(options))
        if "robots" in options.parts:
            console.print(robots(options))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
