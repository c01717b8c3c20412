"""Speed of the simulators compared with Bullet: simulator alone, whole environment, and scaling to two threads.

Bullet uses its default preset and 64 rovers, the number at which it is fastest, as does MuJoCo; Warp uses more. Each
runs on one core, and two are measured alternately in one run. :mod:`benchmarks.gpu` measures Warp on a GPU.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import torch
from rich.table import Table
from torchrl.envs import EnvBase

from benchmarks.engines import choose_engines
from benchmarks.options import Options
from benchmarks.ratios import paired, told
from rover_rl import make_env
from rover_rl.sims import Backend
from rover_rl.sims.backends import resolve_backend
from rover_rl.sims.warp import WarpSettings

WORLDS = ("inspect", "moon", "maze")
BEAMS = (128, 640)
LEVEL = (("maze", 128), ("maze", 32), ("field@1", 128))  # worlds and beams in which Warp's planar tier is measured


def _environment(world: str, rovers: int, beams: int, backend: str | Backend) -> EnvBase:
    env = make_env(world_n=world, num_envs=rovers, lidar_beams=beams, backend=backend, seed=0)
    env.reset()
    return env


def simulator_work(env: EnvBase) -> Callable[[], int]:
    """Returns a function that steps the simulator alone, with changing commands, and returns the number of steps."""
    simulator, rovers = env.base_env.simulator, env.batch_size[0]
    random = torch.Generator().manual_seed(0)
    low, width = torch.tensor((-0.2, -1.0)), torch.tensor((1.2, 2.0))
    commands = [low + width * torch.rand(rovers, 2, generator=random) for _ in range(16)]
    calls = iter(range(10**9))

    def work() -> int:
        simulator.step(commands[next(calls) // 2 % 16])
        return rovers

    return work


def environment_work(env: EnvBase) -> Callable[[], int]:
    """Returns a function that steps the environment with random actions and resets, and returns the number of steps."""
    rovers = env.batch_size[0]
    actions = [env.action_spec.rand() for _ in range(16)]
    state = {"now": env.reset(), "calls": 0}

    def work() -> int:
        state["calls"] += 1
        _, state["now"] = env.step_and_maybe_reset(state["now"].set("action", actions[state["calls"] % 16]))
        return rovers

    return work


def measure(options: Options) -> dict[str, Any]:
    """Measures the speed ratios."""
    rows = []

    def compare(what: str, one: EnvBase, other: EnvBase, work: Callable[[EnvBase], Callable[[], int]]) -> None:
        ratio = told(what, lambda: paired(work(one), work(other), options.seconds, options.rounds))
        rows.append({"what": what, **asdict(ratio)})
        one.close()
        other.close()

    for engine in [name for name in choose_engines(options.engines) if name != "bullet"]:
        one_core = replace(resolve_backend(engine), threads=1)
        rovers, envs = (
            (options.warp_rovers, options.warp_envs) if engine == "warp" else (options.rovers, options.rovers)
        )
        for world in WORLDS:
            for beams in BEAMS:
                fast = _environment(world, rovers, beams, one_core)
                bullet = _environment(world, options.rovers, beams, "bullet")
                compare(f"{engine} / bullet: simulator, {world}, {beams} beams", fast, bullet, simulator_work)
        for world in WORLDS:
            fast = _environment(world, envs, BEAMS[0], one_core)
            bullet = _environment(world, options.rovers, BEAMS[0], "bullet")
            compare(f"{engine} / bullet: environment, {world}, {envs:,} rovers", fast, bullet, environment_work)
        if engine == "warp":
            planar = replace(WarpSettings.preset("planar"), threads=1)
            for world, beams in LEVEL:
                fast, full = (_environment(world, envs, beams, settings) for settings in (planar, one_core))
                compare(f"planar / full engine: environment, {world}, {beams} beams", fast, full, environment_work)
        one, two = (_environment("inspect", rovers, BEAMS[0], replace(one_core, threads=threads)) for threads in (1, 2))
        compare(f"{engine}: two threads / one thread", two, one, simulator_work)
    return {"ratios": rows}


def table(found: dict[str, Any]) -> Table:
    headings = "measured", "steps/s", "Bullet or one thread, steps/s", "speedup"
    ratios = Table(*headings, title="Simulators: speed")
    for row in found["ratios"]:
        ratio = f"{row['median']:.2f} ({row['least']:.2f} to {row['most']:.2f})"
        ratios.add_row(row["what"], f"{row['rate']:,.0f}", f"{row['other']:,.0f}", ratio)
    return ratios
