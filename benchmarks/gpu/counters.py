"""Counters of the kernels from Nsight Compute (``ncu``)."""

from __future__ import annotations

import csv
import subprocess
import sys
from typing import Any

_STALL = "smsp__average_warps_issue_stalled_{}_per_issue_active.ratio"
_WAITS = {
    "long_scoreboard": "memory",
    "lg_throttle": "memory queue",
    "short_scoreboard": "shared memory or special functions",
    "wait": "previous instruction",
    "math_pipe_throttle": "arithmetic units",
    "branch_resolving": "branches",
    "no_instruction": "instruction cache",
    "imc_miss": "constant cache",
    "dispatch_stall": "dispatch",
    "not_selected": "other warps",
}
"""What warps wait for, by the name of the counter."""
_FLOPS = {
    "smsp__sass_thread_inst_executed_op_ffma_pred_on.sum": 2,
    "smsp__sass_thread_inst_executed_op_fadd_pred_on.sum": 1,
    "smsp__sass_thread_inst_executed_op_fmul_pred_on.sum": 1,
}
_PERCENT = {
    "issue_share": "smsp__issue_active.avg.pct_of_peak_sustained_active",
    "occupancy": "sm__warps_active.avg.pct_of_peak_sustained_active",
    "l1_hits": "l1tex__t_sector_hit_rate.pct",
    "l2_hits": "lts__t_sector_hit_rate.pct",
}
_NUMBERS = {
    "dram_bytes": "dram__bytes.sum",
    "l2_bytes": "lts__t_bytes.sum",
    "local_bytes_read": "l1tex__t_bytes_pipe_lsu_mem_local_op_ld.sum",
    "local_bytes_written": "l1tex__t_bytes_pipe_lsu_mem_local_op_st.sum",
    "lanes": "smsp__thread_inst_executed_per_inst_executed.ratio",
}
_TIME = "gpu__time_duration.sum"
METRICS = (_TIME, *_FLOPS, *_PERCENT.values(), *_NUMBERS.values(), *map(_STALL.format, _WAITS))
"""Names of the counters, as ``ncu --query-metrics --chips gh100`` lists them."""
SHOWN_WAITS = 3  # number of reasons for waiting that are reported
TIMEOUT = 150.0
"""Time limit of the profiled program, s: it runs each kernel several times, as the counters do not fit into one run."""


def count(world: str, rovers: int, beams: int) -> list[dict[str, Any]]:
    """Profiles one launch of each kernel, and returns a row for each.

    Raises ``RuntimeError`` if Nsight Compute fails, as where the driver does not let users read the counters.
    """
    command = [
        *("ncu", "--csv", "--page", "raw", "--print-units", "base", "--clock-control", "none"),
        *("--profile-from-start", "no", "--kernel-name", "regex:step_dynamics|scan|plan_routes"),
        *("--metrics", ",".join(METRICS), sys.executable, "-m", "benchmarks.gpu.profiled"),
        *("--world", world, "--rovers", str(rovers), "--beams", str(beams)),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    if done.returncode:
        raise RuntimeError(f"ncu ended with {done.returncode}: {(done.stderr or done.stdout)[-800:]}")
    return read_counters(done.stdout)


def read_counters(output: str) -> list[dict[str, Any]]:
    """Reads what ``ncu --csv --page raw`` prints: names, units, and a line for each launch, else ``RuntimeError``."""
    lines = [*csv.reader(line for line in output.splitlines() if line.startswith('"'))]
    if len(lines) < 3:
        raise RuntimeError(f"ncu printed no counters: {output[-800:]}")
    names, _units, *launches = lines
    return [_row(dict(zip(names, launch, strict=True))) for launch in launches]


def _row(launch: dict[str, str]) -> dict[str, Any]:
    value = {name: float(launch[name].replace(",", "")) for name in METRICS}
    waits = {what: value[_STALL.format(name)] for name, what in _WAITS.items()}
    # With the one that issues, all warps wait for one of the reasons.
    total = sum(waits.values()) + 1
    most = sorted(waits, key=lambda what: waits[what], reverse=True)[:SHOWN_WAITS]
    return {
        "kernel": launch["Kernel Name"],
        "seconds": value[_TIME] * 1e-9,
        "flops": sum(factor * value[name] for name, factor in _FLOPS.items()),
        **{key: value[name] / 100 for key, name in _PERCENT.items()},
        **{key: value[name] for key, name in _NUMBERS.items()},
        "waits": {what: waits[what] / total for what in most},
    }
