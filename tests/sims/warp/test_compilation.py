"""Warp kernels compile for a GPU, on every machine. What they do there is tested in tests/gpu."""

from __future__ import annotations

import pytest

from rover_rl.native.warp import wp
from rover_rl.sims.warp.kernels import placing

HOPPER = 90
"""Compute capability 9.0 (H100, H200)."""


@pytest.mark.slow
@pytest.mark.parametrize(("module", "kernel"), [(placing, "place")])
def test_kernels_compile_for_a_gpu(module, kernel, tmp_path):
    wp.compile_aot_module(module, arch=HOPPER, module_dir=str(tmp_path), use_ptx=True)
    (code,) = tmp_path.glob("*.ptx")
    text = code.read_text()
    assert f".target sm_{HOPPER}" in text
    assert f".entry {kernel}_" in text
