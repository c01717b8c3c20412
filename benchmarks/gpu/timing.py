"""Times of work that a device does asynchronously."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

WARM_UP = 3  # number of calls before the measurement. The first one compiles kernels.
LEAST, MOST = 5, 2000  # numbers of calls in a measurement


@dataclass(frozen=True)
class Timing:
    """Time of one call, s.

    ``wall`` is the mean time from one call to the next, with the device kept busy, ``device`` the median time between
    two events on the device, before and after a call (without a GPU, that of ``host``), and ``host`` the median time
    until a call returns. If it is near ``wall``, the host does not keep up with the device.
    """

    wall: float
    device: float
    host: float


class Phase(NamedTuple):
    """What a GPU does during some work: its duration (s), and name and duration (s) of each kernel and copy."""

    wall: float
    kernels: list[tuple[str, float]]


def timed(
    work: Callable[[], object], device: torch.device, seconds: float, before: Callable[[], object] | None = None
) -> Timing:
    """Calls ``work``, which may return before the device has finished, for about ``seconds``, and returns its times.

    ``before`` is called before each call of ``work``. Only ``wall`` contains its time.
    """
    on_gpu = device.type == "cuda"
    prepare = before or (lambda: None)
    for _ in range(WARM_UP):
        prepare()
        work()
    _wait(device)
    started = time.perf_counter()
    prepare()
    work()
    _wait(device)
    count = int(min(max(seconds / max(time.perf_counter() - started, 1e-6), LEAST), MOST))
    events = [[torch.cuda.Event(enable_timing=True) for _ in range(2)] for _ in range(count if on_gpu else 0)]
    host = []
    started = time.perf_counter()
    for call in range(count):
        prepare()
        called = time.perf_counter()
        if on_gpu:
            events[call][0].record()
        work()
        if on_gpu:
            events[call][1].record()
        host.append(time.perf_counter() - called)
    _wait(device)
    wall = (time.perf_counter() - started) / count
    on_device = [first.elapsed_time(last) / 1000 for first, last in events] or host
    return Timing(wall=wall, device=statistics.median(on_device), host=statistics.median(host))


def profiled(work: Callable[[], object]) -> Phase:
    """Runs work under PyTorch's profiler, and returns what the GPU does during it."""
    with profile(activities=[ProfilerActivity.CUDA]) as profiler:
        started = time.perf_counter()
        work()
        torch.cuda.synchronize()
        wall = time.perf_counter() - started
    events = [event for event in profiler.events() if event.device_type == DeviceType.CUDA]
    return Phase(wall, [(event.name, event.time_range.elapsed_us() * 1e-6) for event in events])


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
