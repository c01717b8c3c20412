"""Warp beside Bullet: the simulator alone with 128 and 640 beams, two threads beside one, and the whole environment.

Bullet has its default preset and 64 rovers, with which it is fastest; Warp has more. Each has one core, and both are
measured in turn in one run. Where there is a GPU, Warp's steps a second there come after: of physics, of lidar, and of
the whole environment.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import torch
from rich.console import Group
from rich.table import Table
from torchrl.envs import EnvBase

from benchmarks.options import Options
from benchmarks.ratios import paired, rate
from rover_rl import make_env
from rover_rl.sims import Backend
from rover_rl.sims.warp import WarpSettings

WORLDS = ("inspect", "moon", "maze")
GPU_ROVERS = (1024, 4096, 16384, 65536)
BEAMS = (128, 640)


def _environment(world: str, rovers: int, beams: int, backend: str | Backend, device: str | None = None) -> EnvBase:
    env = make_env(world_n=world, num_envs=rovers, lidar_beams=beams, backend=backend, seed=0, device=device)
    env.reset()
    return env


def simulating(env: EnvBase) -> Callable[[], int]:
    """Steps of the simulator alone, with commands that change."""
    simulator, rovers = env.base_env.simulator, env.batch_size[0]
    random = torch.Generator().manual_seed(0)
    spread, least = torch.tensor((1.2, 2.0)), torch.tensor((-0.2, -1.0))
    commands = [least + spread * torch.rand(rovers, 2, generator=random) for _ in range(16)]
    calls = iter(range(10**9))

    def work() -> int:
        simulator.step(commands[next(calls) // 2 % 16])
        return rovers

    return work


def driving(env: EnvBase) -> Callable[[], int]:
    """Steps of the whole environment with rewards and resets, under random actions."""
    rovers = env.batch_size[0]
    actions = [env.action_spec.rand() for _ in range(16)]
    state = {"now": env.reset(), "calls": 0}

    def work() -> int:
        state["calls"] += 1
        _, state["now"] = env.step_and_maybe_reset(state["now"].set("action", actions[state["calls"] % 16]))
        return rovers

    return work


def measure(options: Options) -> dict[str, Any]:
    """Rows of ratios; those of a GPU are missing where there is none."""
    one_core = WarpSettings(threads=1)
    rows = []

    def beside(what: str, one: EnvBase, other: EnvBase, work: Callable[[EnvBase], Callable[[], int]]) -> None:
        rows.append({"what": what, **asdict(paired(work(one), work(other), options.seconds, options.rounds))})
        one.close()
        other.close()

    for world in WORLDS:
        for beams in BEAMS:
            warp = _environment(world, options.warp_rovers, beams, one_core)
            bullet = _environment(world, options.rovers, beams, "bullet")
            beside(f"simulator, {world}, {beams} beams", warp, bullet, simulating)
    for world in WORLDS:
        warp = _environment(world, options.warp_envs, BEAMS[0], one_core)
        bullet = _environment(world, options.rovers, BEAMS[0], "bullet")
        beside(f"environment, {world}, {options.warp_envs:,} rovers", warp, bullet, driving)
    one, two = (
        _environment("inspect", options.warp_rovers, BEAMS[0], WarpSettings(threads=threads)) for threads in (1, 2)
    )
    beside("two threads beside one", two, one, simulating)
    return {"ratios": rows, "gpu": _on_a_gpu(options) if torch.cuda.is_available() else None}


def _on_a_gpu(options: Options) -> list[dict[str, Any]]:
    rows = []
    for rovers in GPU_ROVERS:
        env = _environment("maze", rovers, BEAMS[0], "warp", "cuda")

        def finished(work: Callable[[], int]) -> Callable[[], int]:
            def timed() -> int:
                steps = sum(work() for _ in range(10))
                torch.cuda.synchronize()
                return steps

            return timed

        # Rovers that drive, not that stand.
        drive = driving(env)
        for _ in range(20):
            drive()
        launch = env.base_env.simulator.launch
        works = {
            "physics": lambda launch=launch, rovers=rovers: launch(lidar=False) or rovers,
            "lidar": lambda launch=launch, rovers=rovers: launch(physics=False) or rovers,
            "environment": drive,
        }
        rates = {name: rate(finished(work), options.seconds) for name, work in works.items()}
        rows.append({"rovers": rovers, **rates})
        env.close()
    return rows


def table(found: dict[str, Any]) -> Group:
    """For the terminal."""
    ratios = Table("what", "Warp's steps/s", "Bullet's, or one thread's", "times as fast", title="Warp beside Bullet")
    for row in found["ratios"]:
        ratio = f"{row['median']:.2f} ({row['least']:.2f} to {row['most']:.2f})"
        ratios.add_row(row["what"], f"{row['rate']:,.0f}", f"{row['other']:,.0f}", ratio)
    if found["gpu"] is None:
        return Group(ratios, "On a GPU: skipped, torch finds no CUDA device here")
    gpu = Table("rovers", "physics", "lidar", "environment", title="Warp on a GPU, steps/s")
    for row in found["gpu"]:
        gpu.add_row(*(f"{row[name]:,.0f}" for name in ("rovers", "physics", "lidar", "environment")))
    return Group(ratios, gpu)
