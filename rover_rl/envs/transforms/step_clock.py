"""``StepClock``: transform that measures the time spent in the simulator and in the environment."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from rover_rl.sims.base import Simulator

_KEY = "clock"
NAMES = ("worker", "simulator", "environment")
"""Entries of ``clock``."""


class StepClock(Transform):
    """Adds the nested entry ``clock``: accumulated times of this process, float64 ``[N, 1]``, the same in every row.

    - ``("clock", "worker")``: index of the process;
    - ``("clock", "simulator")``: time spent in the simulator (physics and lidar), s;
    - ``("clock", "environment")``: time spent in steps of the environment, including the simulator and the transforms
      before this one, s.

    The times are part of the data, so that they are also available from collectors in other processes. On a GPU, each
    measurement synchronizes with the device.

    Args:
        simulator: simulator whose methods are timed from now on.
        worker: index of this process.
    """

    def __init__(self, simulator: Simulator, worker: int = 0) -> None:
        super().__init__()
        self._started = 0.0
        self._device = simulator.device
        self._values = torch.tensor((worker, 0.0, 0.0), dtype=torch.float64)
        for method in ("step", "reset"):
            setattr(simulator, method, self._timed(getattr(simulator, method)))

    def _timed(self, method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            started = self._seconds()
            result = method(*args, **kwargs)
            self._values[1] += self._seconds() - started
            return result

        return call

    def _seconds(self) -> float:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return time.perf_counter()

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._started = self._seconds()
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._values[2] += self._seconds() - self._started
        return self._write(next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._write(tensordict_reset)

    def _write(self, tensordict: TensorDictBase) -> TensorDictBase:
        # Copied on the CPU, too, because the returned values must not change later.
        entries = self._values.to(tensordict.device or "cpu", copy=True).expand(*tensordict.batch_size, 3)
        for name, values in zip(NAMES, entries.split(1, -1), strict=True):
            tensordict.set((_KEY, name), values)
        return tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Adds ``clock``."""
        shape = observation_spec.shape
        leaf = Unbounded(shape=(*shape, 1), dtype=torch.float64, device=observation_spec.device)
        observation_spec[_KEY] = Composite({name: leaf.clone() for name in NAMES}, shape=shape)
        return observation_spec
