"""No step on the GPU waits for it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from rover_rl.envs.sensors.route import Route
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from tests.gpu.driven import environment


@contextmanager
def waiting_forbidden(device: torch.device) -> Iterator[None]:
    """Makes PyTorch raise an error for every operation that waits for the GPU."""
    if device.type != "cuda":
        yield
        return
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_a_step_and_a_reset_do_not_wait(gpu: torch.device) -> None:
    repeat = 4
    env = environment(gpu, 256, lidar_points=128, length=2000, sensors=[Route(period=repeat)])
    env = env.append_transform(ActionRepeat(repeat))
    td = env.reset()
    action = torch.full((256, 2), 0.3, device=gpu)
    mask = (torch.arange(256, device=gpu) % 3 == 0)[:, None]
    # The first step reads TorchRL's specs and compiles kernels.
    td = env.step(td.set("action", action))["next"]
    env._reset(td.exclude("reward").set("_reset", mask))
    with waiting_forbidden(gpu):
        for _ in range(3):
            # TorchRL's step() and reset() read values themselves.
            after = env._step(td.set("action", action))
            env._reset(after.exclude("reward").set("_reset", mask))
