"""What goes wrong on a GPU is told in a sentence, and loses nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from rover_rl.cli.main import FAILED, main
from tests.gpu.driven import drive, environment


def test_a_gpu_that_is_not_there_is_an_error(gpu: torch.device, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "--backend", "warp", "--device", "cuda:99"]) == FAILED
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert "device='cuda:99' is not available: PyTorch" in lines[0]


def test_too_little_memory_is_an_error(
    gpu: torch.device, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if gpu.type != "cuda":
        pytest.skip("would fill the machine's memory")
    # Maps of a million rovers take 390 GB.
    options = ["--observation", "lidar", "imu", "target", "velocities", "route", "--prior", "route"]
    options += ["--device", str(gpu), "--num-envs", "1000000", "--runs", str(tmp_path)]
    code = main(["train", "--world", "maze", "--backend", "warp", *options])
    assert code == FAILED
    (line,) = capsys.readouterr().err.splitlines()[-1:]
    assert "not enough memory" in line
    # The GPU can be used again.
    torch.cuda.empty_cache()
    drive(environment(gpu, 8), 2)
