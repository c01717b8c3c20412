"""Tests that need a GPU: ``pytest -m gpu``. ``ROVER_RL_GPU=cpu pytest tests/gpu`` rehearses them on the CPU."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks all tests of this folder."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.gpu)


@pytest.fixture
def gpu() -> torch.device:
    """The GPU, or the device that ``ROVER_RL_GPU`` names."""
    device = torch.device(os.environ.get("ROVER_RL_GPU", "cuda"))
    if device.type == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    return device
