"""``python -m benchmarks gpu``: a rehearsal on the CPU, and what is read from profilers."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console

from benchmarks import gpu
from benchmarks.gpu import kernels, speed, training
from benchmarks.gpu.counters import METRICS, read_counters
from benchmarks.options import Options


@pytest.fixture
def options(tmp_path: Path) -> Options:
    small = {"gpu_rovers": (4,), "gpu_beams": (32,), "gpu_worlds": ("maze:0-1",), "gpu_learners": (4,)}
    return Options(device="cpu", **small, warp_envs=8, gpu_seconds=0.01, out=tmp_path)


def shown(table: Any) -> str:
    """What a wide console prints."""
    output = io.StringIO()
    Console(width=160, file=output).print(table)
    return output.getvalue()


@pytest.mark.slow
def test_a_rehearsal_on_the_cpu_measures_everything(
    options: Options, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(speed, "DRIVEN", 4)
    monkeypatch.setattr(training, "BATCHES", 1)
    results = gpu.measure(options)
    assert results is not None
    assert json.loads((tmp_path / "gpu.json").read_text()) == results
    assert [(row["world"], row["rovers"]) for row in results["speed"]] == [("maze:0-1", 4)]
    for row in results["speed"]:
        # Physics and lidar are a part of the step.
        assert row["physics"] > row["environment"] > 0
        assert row["lidar"] > row["environment"]
        assert row["step_s"] > 0
    assert [(row["rovers"], row["part"]) for row in results["steps"]] == [(4, "reset"), (4, "step")]
    assert all(row["wall_s"] > 0 for row in results["steps"])
    assert all(row["steps_per_s"] > 0 for row in results["training"])
    assert {row["map"] for row in results["training"]} == {True, False}
    assert results["machine"]["bytes_per_s"] > 0
    told = shown(gpu.table(results))
    assert "failed" not in told
    assert all(title in told for title in ("Machine", "Steps/s", "A step of", "Kernels", "PPO"))


def test_a_section_that_fails_does_not_end_the_others(options: Options, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("no counters")

    for name in gpu.SECTIONS:
        monkeypatch.setattr(f"benchmarks.gpu.{name}.measure", fail)
    results = gpu.measure(options)
    assert results is not None
    assert {results[name]["error"] for name in gpu.SECTIONS} == {"RuntimeError: no counters"}
    assert shown(gpu.table(results)).count("failed:") == len(gpu.SECTIONS)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_without_a_gpu_it_is_skipped(options: Options, tmp_path: Path) -> None:
    assert gpu.measure(replace(options, device=None)) is None
    assert not list(tmp_path.iterdir())


def profiled(*launches: dict[str, str]) -> str:
    """What ``ncu --csv --page raw`` prints, with its own lines in between."""
    names = ["ID", "Kernel Name", *METRICS]
    out = io.StringIO()
    writer = csv.writer(out, quoting=csv.QUOTE_ALL)
    writer.writerow(names)
    writer.writerow(["", "", *["unit"] * len(METRICS)])
    for number, launch in enumerate(launches):
        writer.writerow([str(number), *(launch.get(name, "0") for name in names[1:])])
    return "==PROF== Connected to process 1\n" + out.getvalue() + "==PROF== Disconnected\n"


def test_counters_are_read_from_nsight_compute() -> None:
    output = profiled(
        {
            "Kernel Name": "step_dynamics_1234_cuda_kernel_forward",
            "gpu__time_duration.sum": "2,000,000",
            "smsp__sass_thread_inst_executed_op_ffma_pred_on.sum": "1,000",
            "smsp__sass_thread_inst_executed_op_fadd_pred_on.sum": "10",
            "smsp__sass_thread_inst_executed_op_fmul_pred_on.sum": "1",
            "dram__bytes.sum": "5,000",
            "smsp__thread_inst_executed_per_inst_executed.ratio": "8.5",
            "sm__warps_active.avg.pct_of_peak_sustained_active": "12.5",
            "smsp__average_warps_issue_stalled_long_scoreboard_per_issue_active.ratio": "3",
            "smsp__average_warps_issue_stalled_wait_per_issue_active.ratio": "1",
        },
        {"Kernel Name": "scan"},
    )
    physics, scan = read_counters(output)
    assert physics["seconds"] == pytest.approx(0.002)
    assert physics["flops"] == 2011
    assert (physics["dram_bytes"], physics["lanes"], physics["occupancy"]) == (5000, 8.5, 0.125)
    assert list(physics["waits"])[:2] == ["memory", "previous instruction"]
    # Three of five warps wait for memory, one for an instruction before, and one issues.
    assert list(physics["waits"].values())[:2] == pytest.approx([0.6, 0.2])
    assert scan["kernel"] == "scan"


def test_counters_that_cannot_be_read_do_not_lose_the_times(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("ncu ended with 1: ERR_NVGPUCTRPERM")

    monkeypatch.setattr(kernels, "count", fail)
    found = kernels.counted("maze", 8, 32, {"flops_per_s": 1.0, "bytes_per_s": 1.0})
    assert found == {"counters_error": "RuntimeError: ncu ended with 1: ERR_NVGPUCTRPERM"}
    case = {"world": "maze", "rovers": 8, "beams": 32, "seconds": {"scan": 0.004}}
    told = shown(kernels.table({**case, **found}))
    assert "4.000" in told
    assert "ERR_NVGPUCTRPERM" in told
