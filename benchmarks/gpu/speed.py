"""Steps per second of physics, lidar and whole environment, by number of rovers, beams and worlds."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from rich.table import Table
from tensordict import TensorDictBase

from benchmarks.gpu.timing import timed
from benchmarks.options import Options
from rover_rl import make_env
from rover_rl.algos.train.collectors import with_new_episodes
from rover_rl.native.warp import wp
from rover_rl.sims.warp import WarpSettings

DRIVEN = 40  # number of steps before a measurement: by then the rovers are in motion, and some episodes have ended
LENGTH = 500  # number of steps of an episode, as in the training of the package's policies
MANY_ROVERS = 65_536  # number of rovers, at most, in the other worlds


def measure(options: Options, device: torch.device, _: dict[str, Any]) -> list[dict[str, Any]]:
    """Measures each number of rovers and beams in the first world, and one number of rovers in the others."""
    first, *others = options.gpu_worlds
    cases = [(first, rovers, beams) for beams in options.gpu_beams for rovers in options.gpu_rovers]
    many = min(MANY_ROVERS, max(options.gpu_rovers))
    cases += [(world, many, beams) for world in others for beams in options.gpu_beams]
    return [_case(options, device, *case) for case in cases]


def _case(options: Options, device: torch.device, world: str, rovers: int, beams: int) -> dict[str, Any]:
    case = {"world": world, "rovers": rovers, "beams": beams}
    try:
        with driving(world, rovers, beams, device) as drive:
            rover, used = drive.env.base_env, drive.used
            kernels = {"physics": rover.simulator.launch, "lidar": rover.scanner.launch}
            times = {name: timed(work, device, options.gpu_seconds, drive.step) for name, work in kernels.items()}
            step = timed(drive.step, device, options.gpu_seconds)
    except (MemoryError, RuntimeError) as error:
        # The largest numbers need not fit into every GPU.
        return {**case, "error": str(error).splitlines()[0]}
    return {
        **case,
        **{name: rovers / timing.device for name, timing in times.items()},
        "environment": rovers / step.wall,
        "task_share": 1 - sum(timing.device for timing in times.values()) / step.wall,
        "host_s": step.host,
        "step_s": step.wall,
        "bytes_per_rover": None if used is None else used / rovers,
    }


class Drive:
    """Rovers that drive with random actions, in an environment with all rewards.

    ``used`` is the memory that the environment takes on the GPU, bytes; ``None`` on the CPU.
    """

    def __init__(
        self, world: str, rovers: int, beams: int, device: torch.device, settings: WarpSettings | None = None
    ) -> None:
        before = _used(device)
        described = {"world_n": world, "num_envs": rovers, "lidar_beams": beams, "device": str(device)}
        self.env = make_env(**described, backend=settings or WarpSettings(), seed=0, length=LENGTH)
        self._actions = [self.env.action_spec.rand() for _ in range(16)]
        self._now, self._steps = self.env.reset(), 0
        for _ in range(DRIVEN):
            self.step()
        after = _used(device)
        self.used = None if before is None or after is None else after - before

    @property
    def observation(self) -> TensorDictBase:
        return self._now

    def step(self) -> None:
        """Resets the episodes that have ended, and takes a step, as training does. All rovers have moved in the end."""
        now = with_new_episodes(self.env, self._now)
        self._steps += 1
        # An action is held for half a second, so that the rovers get somewhere.
        action = self._actions[self._steps // 10 % len(self._actions)]
        self._now = self.env.step_mdp(self.env.step(now.set("action", action)))


@contextmanager
def driving(
    world: str, rovers: int, beams: int, device: torch.device, settings: WarpSettings | None = None
) -> Iterator[Drive]:
    """Opens a :class:`Drive`, and gives its memory back at the end."""
    drive = Drive(world, rovers, beams, device, settings)
    try:
        yield drive
    finally:
        drive.env.close()
        del drive
        gc.collect()
        if device.type == "cuda":
            torch.cuda.empty_cache()


def _used(device: torch.device) -> int | None:
    """Memory of the GPU that torch and Warp have given out, bytes."""
    if device.type != "cuda":
        return None
    torch.cuda.synchronize(device)
    return torch.cuda.memory_allocated(device) + wp.get_mempool_used_mem_current(wp.device_from_torch(device))


def table(rows: list[dict[str, Any]]) -> Table:
    headings = "world", "rovers", "beams", "physics", "lidar", "environment", "task", "host, ms", "step, ms", "kB/rover"
    table = Table(*headings, title="Steps/s, and the share of a step outside the two kernels")
    for row in rows:
        case = row["world"], f"{row['rovers']:,}", str(row["beams"])
        if "error" in row:
            table.add_row(*case, row["error"])
            continue
        used = row["bytes_per_rover"]
        table.add_row(
            *case,
            *(f"{row[name]:,.0f}" for name in ("physics", "lidar", "environment")),
            f"{row['task_share']:.0%}",
            f"{1000 * row['host_s']:.2f}",
            f"{1000 * row['step_s']:.2f}",
            "" if used is None else f"{used / 1000:.1f}",
        )
    return table
