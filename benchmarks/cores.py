"""Speedup of rollouts by parallel workers: all workers compared with one, for the same number of rovers."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from rich.table import Table

from benchmarks.collecting import rollouts
from benchmarks.options import Options
from benchmarks.ratios import paired


def measure(options: Options) -> dict[str, Any]:
    """Measures steps per second with one worker and with all workers."""
    beams = 128
    with (
        rollouts(options.world, options.rovers, beams, options.workers) as all_workers,
        rollouts(options.world, options.rovers, beams, 1) as one_worker,
    ):
        ratio = paired(all_workers, one_worker, options.seconds, options.rounds)
    return {"workers": options.workers, **asdict(ratio)}


def table(result: dict[str, Any]) -> Table:
    """Formats the result for the terminal."""
    table = Table("workers", "steps/s", "steps/s with one", "ratio", title="All workers compared with one")
    table.add_row(
        str(result["workers"]),
        f"{result['rate']:,.0f}",
        f"{result['other']:,.0f}",
        f"{result['median']:.2f} ({result['least']:.2f} to {result['most']:.2f})",
    )
    return table
