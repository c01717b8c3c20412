"""Time of each kernel beside what its arithmetic and its bytes need, and why it takes longer.

The time that a kernel needs at least is the larger of its float32 operations over the measured arithmetic rate and its
bytes in device memory over the measured bandwidth. Nsight Compute counts both. It also tells what the rest of the time
is: lanes of a warp that wait for others (divergence), too few warps on a multiprocessor, and what the warps wait for.
"""

from __future__ import annotations

import shutil
import subprocess
from typing import Any

import torch
from rich.console import Group
from rich.table import Table

from benchmarks.gpu.counters import count
from benchmarks.gpu.kernel_resources import resident_threads
from benchmarks.gpu.profiled import map_work
from benchmarks.gpu.speed import driving
from benchmarks.gpu.timing import timed
from benchmarks.options import Options
from rover_rl.envs.seen_map.route_kernels import close_ways, plan_routes
from rover_rl.envs.seen_map.scan_kernels import add_scans
from rover_rl.native.warp import wp
from rover_rl.sims.warp.kernels.dynamics import step_dynamics
from rover_rl.sims.warp.kernels.lidar import scan
from rover_rl.sims.warp.kernels.placing import place
from rover_rl.sims.warp.simulator import GPU_BLOCK_SIZE

KERNELS = {kernel.key: kernel for kernel in (step_dynamics, scan, place, add_scans, close_ways, plan_routes)}
"""Kernels of a step, of a reset and of the map, by their names."""
ROVERS = 65_536  # number of rovers, at most


def measure(options: Options, device: torch.device, results: dict[str, Any]) -> dict[str, Any]:
    """Times physics, lidar and map, and reads registers, occupancy and counters of the kernels on a GPU."""
    rovers, beams = min(ROVERS, max(options.gpu_rovers)), min(options.gpu_beams)
    world = options.gpu_worlds[0]
    with driving(world, rovers, beams, device) as drive:
        rover = drive.env.base_env
        works = {
            "step_dynamics": rover.simulator.launch,
            "scan": rover.scanner.launch,
            "add_scans and plan_routes": map_work(drive, device),
        }
        times = {name: timed(work, device, options.gpu_seconds, drive.step).device for name, work in works.items()}
    found: dict[str, Any] = {"world": world, "rovers": rovers, "beams": beams, "seconds": times}
    if device.type == "cuda":
        found["resources"] = {name: _resources(kernel) for name, kernel in KERNELS.items()}
        if shutil.which("ncu"):
            found |= counted(world, rovers, beams, results["machine"])
    return found


def counted(world: str, rovers: int, beams: int, machine: dict[str, Any]) -> dict[str, Any]:
    """Returns ``counters``, or ``counters_error`` if Nsight Compute fails: the times measured before remain.

    ``machine`` holds the measured ceilings, ``flops_per_s`` and ``bytes_per_s``.
    """
    try:
        return {"counters": _limits(count(world, rovers, beams), machine)}
    except (RuntimeError, ValueError, KeyError, subprocess.TimeoutExpired) as error:
        return {"counters_error": f"{type(error).__name__}: {error}"}


def _resources(kernel: wp.Kernel) -> dict[str, Any]:
    """Registers and local memory of a thread, and how many threads fit on a multiprocessor."""
    found: dict[str, Any] = wp.get_cuda_kernel_properties(kernel, block_dim=GPU_BLOCK_SIZE)
    return found | {"resident_threads": resident_threads(found["register_count"])}


def _limits(rows: list[dict[str, Any]], machine: dict[str, Any]) -> list[dict[str, Any]]:
    """Adds the shares of the time that arithmetic and device memory need at the measured ceilings."""
    for row in rows:
        row["arithmetic_share"] = row["flops"] / machine["flops_per_s"] / row["seconds"]
        row["memory_share"] = row["dram_bytes"] / machine["bytes_per_s"] / row["seconds"]
    return rows


def table(found: dict[str, Any]) -> Group:
    case = f"{found['rovers']:,} rovers, {found['beams']} beams, {found['world']}"
    times = Table("kernels", "ms", "rovers/s", title=f"Kernels: {case}")
    for name, seconds in found["seconds"].items():
        times.add_row(name, f"{1000 * seconds:.3f}", f"{found['rovers'] / seconds:,.0f}")
    parts: list[Table | str] = [times]
    if found.get("resources"):
        columns = "kernel", "registers", "local memory, bytes", "threads on a multiprocessor"
        resources = Table(*columns, title="Resources of a thread")
        for name, row in found["resources"].items():
            numbers = row["register_count"], row["local_memory_size"], row["resident_threads"]
            resources.add_row(name, *map(str, numbers))
        parts.append(resources)
    if "counters" in found:
        parts.append(_counters_table(found["counters"]))
    if "counters_error" in found:
        parts.append(f"No counters. {found['counters_error']}")
    return Group(*parts)


def _counters_table(rows: list[dict[str, Any]]) -> Table:
    table = Table(
        *("kernel", "ms", "arithmetic", "memory", "issue slots", "lanes of 32", "occupancy", "L1 hits", "waits for"),
        title="Shares of the time that a kernel needs at the measured ceilings, and why it takes longer",
    )
    for row in rows:
        table.add_row(
            row["kernel"],
            f"{1000 * row['seconds']:.3f}",
            f"{row['arithmetic_share']:.1%}",
            f"{row['memory_share']:.1%}",
            f"{row['issue_share']:.0%}",
            f"{row['lanes']:.1f}",
            f"{row['occupancy']:.0%}",
            f"{row['l1_hits']:.0%}",
            ", ".join(f"{name} {share:.0%}" for name, share in row["waits"].items()),
        )
    return table
