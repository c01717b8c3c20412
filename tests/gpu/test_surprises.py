"""What goes wrong on a GPU is told in a sentence, and loses nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from rover_rl.algos.config import with_settings
from rover_rl.algos.config_files import run_config
from rover_rl.algos.train import train
from rover_rl.algos.train.progress import read_progress
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


def test_another_process_may_use_the_gpu(gpu: torch.device) -> None:
    held = environment(gpu, 64)
    held.reset()
    code = (
        f"from rover_rl import make_env; env = make_env(world_n='maze', num_envs=64, backend='warp', device='{gpu}'); "
        "print(env.rollout(5)['lidar'].shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)
    assert done.stdout.strip() == "torch.Size([64, 5, 32])", done.stderr
    assert drive(held, 3)[-1]["pose"].isfinite().all()


def test_an_interrupted_training_goes_on(gpu: torch.device, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "rover_rl.cli.main", "train", "--world", "maze", "--backend", "warp"]
    command += [
        "--device",
        str(gpu),
        "--num-envs",
        "64",
        "--max-minutes",
        "5",
        "--runs",
        str(tmp_path),
        "--name",
        "run",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        progress, deadline = tmp_path / "run" / "progress.csv", time.monotonic() + 240
        while time.monotonic() < deadline and not (progress.is_file() and len(progress.read_text().splitlines()) > 2):
            assert process.poll() is None, process.stdout.read()  # type: ignore[union-attr]
            time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        output = process.communicate(timeout=120)[0]
    assert process.returncode == 130, output
    before = read_progress(progress)["steps"]
    config = with_settings(run_config(tmp_path / "run"), total_steps=int(before[-1]) + 4096)
    summary = train(config, tmp_path / "run")
    after = read_progress(progress)["steps"]
    assert list(after[: len(before)]) == list(before)
    assert summary.steps > before[-1]
    assert os.path.getsize(summary.checkpoint) > 0
