"""Speed on a GPU: simulator, environment and training, what bounds each kernel, and the processors beside it.

    python -m benchmarks gpu
    python -m benchmarks gpu --device cpu --gpu-rovers 64 256 --gpu-learners 64 --gpu-seconds 0.1   # a rehearsal

Meant to take less than eight minutes on an H100 or H200. Writes ``gpu.json`` after each section, so that little is lost
if the machine goes away. A section that fails is reported with its error, and the others go on.

- ``machine``: GPU, versions, and measured ceilings: memory bandwidth, float32 arithmetic, and the cost of a launch.
- ``speed``: steps per second of physics, lidar and whole environment, by number of rovers, beams and worlds, and memory
  per rover.
- ``steps``: what the device does in a step of the environment, kernel by kernel, and how many launches the host makes.
- ``kernels``: time of each kernel beside what its arithmetic and its bytes need at the measured ceilings. With Nsight
  Compute (``ncu``), also divergence, occupancy and what warps wait for.
- ``training``: speed of PPO, and the shares of simulation, gradient steps and idle time of the device.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

import torch
from rich.console import Group

from benchmarks.options import Options
from benchmarks.ratios import told
from rover_rl.files import write_json

SECTIONS = ("machine", "speed", "steps", "kernels", "training")  # what matters most comes first


def measure(options: Options) -> dict[str, Any] | None:
    """Measures all sections. Returns ``None`` without a GPU, unless ``--device`` names a device."""
    device = options.device or ("cuda" if torch.cuda.is_available() else None)
    if device is None:
        return None
    results: dict[str, Any] = {"device": device}
    # Warp needs its number: "cuda" alone has none.
    place = torch.empty(0, device=device).device
    for name in SECTIONS:
        section = import_module(f"{__name__}.{name}")
        results[name] = told(name, partial(_attempt, section.measure, options, place, results))
        write_json(options.out / "gpu.json", results)
    return results


def _attempt(section: Callable[..., Any], *args: Any) -> Any:
    """Returns the results of a section, or its error: the first failure should not end a measurement of minutes."""
    try:
        return section(*args)
    except Exception as error:
        return {"error": f"{type(error).__name__}: {error}", "traceback": traceback.format_exc()}


def table(results: dict[str, Any] | None) -> Group:
    if results is None:
        return Group("GPU: skipped, torch finds no CUDA device (--device cpu rehearses the measurement)")
    parts = []
    for name in SECTIONS:
        found = results[name]
        failed = isinstance(found, dict) and "error" in found
        section = import_module(f"{__name__}.{name}")
        parts.append(f"{name} failed:\n{found['traceback']}" if failed else section.table(found))
    return Group(*parts)
