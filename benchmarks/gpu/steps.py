"""What the device does in a step of the environment: its kernels by time, and the launches that the host makes.

A step of training is two calls: the reset of the rows whose episode has ended, by mask and without reading whether
there are any, and the step with ``step_mdp``. Host and device work at the same time, so that a step takes as long as
the slower of the two.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import torch
from rich.console import Group
from rich.table import Table

from benchmarks.gpu.speed import MANY_ROVERS, Drive, driving
from benchmarks.gpu.timing import profiled, timed
from benchmarks.options import Options
from rover_rl.algos.train.collectors import with_new_episodes

CALLS = 3  # number of profiled calls
LARGEST = 12  # number of kernels that are listed


def measure(options: Options, device: torch.device, _: dict[str, Any]) -> list[dict[str, Any]]:
    """Measures reset and step, with few rovers and with many."""
    numbers = sorted({min(options.gpu_rovers), min(MANY_ROVERS, max(options.gpu_rovers))})
    rows = []
    for rovers in numbers:
        with driving(options.gpu_worlds[0], rovers, min(options.gpu_beams), device) as drive:
            for name, work in _parts(drive).items():
                timing = timed(work, device, options.gpu_seconds)
                row = {"rovers": rovers, "part": name, "wall_s": timing.wall, "host_s": timing.host}
                rows.append(row | (_kernels(work) if device.type == "cuda" else {}))
    return rows


def _parts(drive: Drive) -> dict[str, Callable[[], object]]:
    env, now = drive.env, drive.observation
    given = with_new_episodes(env, now).set("action", env.action_spec.zero())
    return {"reset": lambda: with_new_episodes(env, now), "step": lambda: env.step_mdp(env.step(given))}


def _kernels(work: Callable[[], object]) -> dict[str, Any]:
    """Profiles calls: time of the device and launches of one, and the kernels that take most of it."""
    work()

    def repeat() -> None:
        for _ in range(CALLS):
            work()

    total: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
    for name, seconds in profiled(repeat).kernels:
        total[name][0] += seconds / CALLS
        total[name][1] += 1 / CALLS
    largest = sorted(total.items(), key=lambda item: item[1], reverse=True)[:LARGEST]
    return {
        "device_s": sum(seconds for seconds, _ in total.values()),
        "launches": sum(count for _, count in total.values()),
        "kernels": [{"kernel": name, "seconds": seconds, "launches": count} for name, (seconds, count) in largest],
    }


def table(rows: list[dict[str, Any]]) -> Group:
    calls = Table("rovers", "call", "ms", "host, ms", "device, ms", "launches", title="A step of the environment")
    for row in rows:
        device = (f"{1000 * row['device_s']:.2f}", f"{row['launches']:.0f}") if "device_s" in row else ()
        times = f"{1000 * row['wall_s']:.2f}", f"{1000 * row['host_s']:.2f}"
        calls.add_row(f"{row['rovers']:,}", row["part"], *times, *device)
    kernels = Table("rovers", "call", "kernel", "ms", "launches", title="Kernels that take most of it")
    for row in rows:
        for kernel in row.get("kernels", ()):
            name, numbers = kernel["kernel"][:90], (f"{1000 * kernel['seconds']:.3f}", f"{kernel['launches']:.0f}")
            kernels.add_row(f"{row['rovers']:,}", row["part"], name, *numbers)
    return Group(calls, kernels) if kernels.row_count else Group(calls)
