"""Warp kernels on a GPU: ahead-of-time compilation on every machine, execution where a GPU is available."""

from __future__ import annotations

import pytest
import torch

from rover_rl import make_env
from rover_rl.sims.native.warp import wp
from rover_rl.sims.warp.kernels import dynamics, lidar

HOPPER = 90
"""Compute capability 9.0 (H100, H200)."""


@pytest.mark.slow
@pytest.mark.parametrize(("module", "kernels"), [(dynamics, ("step_dynamics", "place")), (lidar, ("scan",))])
def test_kernels_compile_for_a_gpu(module, kernels, tmp_path):
    wp.compile_aot_module(module, arch=HOPPER, module_dir=str(tmp_path), use_ptx=True)
    (code,) = tmp_path.glob("*.ptx")
    text = code.read_text()
    assert f".target sm_{HOPPER}" in text
    for kernel in kernels:
        assert f".entry {kernel}_" in text


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_gpu_matches_cpu():
    rollouts = []
    for device in ("cpu", "cuda"):
        env = make_env(backend="warp", world_n=["inspect", "maze"], num_envs=64, seed=0, device=device)
        td = env.reset()
        for _ in range(20):
            td = env.step(td.set("action", torch.tensor([[0.7, 0.2]] * 64, device=device)))["next"]
        assert td["lidar"].device.type == device
        rollouts.append(td.to("cpu"))
    on_cpu, on_gpu = rollouts
    # CPU and GPU round differently, and contacts amplify the differences.
    torch.testing.assert_close(on_gpu["pose"], on_cpu["pose"], atol=0.01, rtol=0)
    assert ((on_gpu["lidar"] - on_cpu["lidar"]).abs() < 0.05).float().mean() > 0.97
