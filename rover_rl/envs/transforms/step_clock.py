"""StepClock: where the time of a step goes, told by the process that takes it."""

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
"""What the clock tells, in this order."""


class StepClock(Transform):
    """Adds ``clock``: seconds that this process has spent so far, float64 ``[N, 1]``, the same on every row.

    ``("clock", "simulator")`` in the simulator (physics and lidar), ``("clock", "environment")`` in steps of the
    environment, the simulator's and those of the transforms before this one included. ``("clock", "worker")`` says
    whose they are. Being part of the data, they come along from collectors in other processes. What is on a GPU is
    waited for at each look at the clock.

    Args:
        simulator: to be timed from now on.
        worker: number of this process.
    """

    def __init__(self, simulator: Simulator, worker: int = 0) -> None:
        super().__init__()
        self._started = 0.0
        self._device = simulator.device
        self._told = torch.tensor((worker, 0.0, 0.0), dtype=torch.float64)
        for method in ("step", "reset"):
            setattr(simulator, method, self._timed(getattr(simulator, method)))

    def _timed(self, method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            started = self._seconds()
            result = method(*args, **kwargs)
            self._told[1] += self._seconds() - started
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
        self._told[2] += self._seconds() - self._started
        return self._written(next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._written(tensordict_reset)

    def _written(self, tensordict: TensorDictBase) -> TensorDictBase:
        # On the CPU this copies, too: what is told must not change afterwards.
        told = self._told.to(tensordict.device or "cpu", copy=True).expand(*tensordict.batch_size, 3)
        for name, values in zip(NAMES, told.split(1, -1), strict=True):
            tensordict.set((_KEY, name), values)
        return tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Adds ``clock``."""
        shape = observation_spec.shape
        leaf = Unbounded(shape=(*shape, 1), dtype=torch.float64, device=observation_spec.device)
        observation_spec[_KEY] = Composite({name: leaf.clone() for name in NAMES}, shape=shape)
        return observation_spec
