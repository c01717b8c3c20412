"""``StepClock``: transform that measures the time spent in the simulator and in the environment."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from rover_rl.envs.rover import RoverEnv

_KEY = "clock"
NAMES = ("worker", "simulator", "environment")
"""Entries of ``clock``."""


class StepClock(Transform):
    """Adds the nested entry ``clock``: accumulated times of this process, float64 ``[N, 1]``, the same in every row.

    - ``("clock", "worker")``: index of the process;
    - ``("clock", "simulator")``: time spent in the simulator (physics and lidar), s;
    - ``("clock", "environment")``: time spent in steps and resets of the environment, including the simulator and, in
      steps, the transforms before this one, s.

    The times are part of the data, so that they are also available from collectors in other processes. On a GPU, each
    measurement synchronizes with the device, unless times are summed ``per_batch``: then they are those at the end of
    the batch, measured with events of the device, and 0 before :meth:`batch_collected`.
    """

    def __init__(self, env: RoverEnv, worker: int = 0, per_batch: bool = False) -> None:
        super().__init__()
        self._device = env.simulator.device
        self._values = [float(worker), 0.0, 0.0]
        self._events: dict[int, list[tuple[Any, Any]]] | None = None
        if per_batch and self._device.type != "cpu":
            self._events = {1: [], 2: []}
        self._started: Any = 0.0
        for part, method in ((env.simulator, "step"), (env.simulator, "reset"), (env.scanner, "scan")):
            setattr(part, method, self._timed(1, getattr(part, method)))
        env._reset = self._timed(2, env._reset)  # type: ignore[method-assign]

    def _timed(self, index: int, method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            started = self._now()
            result = method(*args, **kwargs)
            self._add(index, started)
            return result

        return call

    def _now(self) -> Any:
        if self._events is not None:
            event = torch.get_device_module(self._device).Event(enable_timing=True)
            event.record()
            return event
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return time.perf_counter()

    def _add(self, index: int, started: Any) -> None:
        if self._events is None:
            self._values[index] += self._now() - started
        else:
            self._events[index].append((started, self._now()))

    def batch_collected(self, batch: TensorDictBase) -> None:
        """Waits for the device and sets the times of a batch ``[N, T]``, if they are summed per batch."""
        if self._events is None:
            return
        torch.get_device_module(self._device).synchronize(self._device)
        for index, events in self._events.items():
            self._values[index] += sum(started.elapsed_time(ended) for started, ended in events) / 1000
            events.clear()
        for name, value in zip(NAMES, self._values, strict=True):
            batch["next", _KEY, name].fill_(value)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._started = self._now()
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._add(2, self._started)
        return self._write(next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._write(tensordict_reset)

    def _write(self, tensordict: TensorDictBase) -> TensorDictBase:
        kind: dict[str, Any] = {"dtype": torch.float64, "device": tensordict.device}
        values = torch.tensor(self._values, **kind) if self._events is None else torch.zeros(3, **kind)
        entries = values.expand(*tensordict.batch_size, 3)
        for name, entry in zip(NAMES, entries.split(1, -1), strict=True):
            tensordict.set((_KEY, name), entry)
        return tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        shape = observation_spec.shape
        leaf = Unbounded(shape=(*shape, 1), dtype=torch.float64, device=observation_spec.device)
        observation_spec[_KEY] = Composite({name: leaf.clone() for name in NAMES}, shape=shape)
        return observation_spec
