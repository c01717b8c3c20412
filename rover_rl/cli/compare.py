"""The command ``rover-rl compare``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from rover_rl.cli.options import Force
from rover_rl.files import check_outputs


@dataclass(frozen=True)
class Compare:
    """Compare training runs by their learning curves, over several seeds.

    Writes comparison.png, comparison.csv, runs.csv and comparison.json.
    """

    runs: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(help="Folders of runs, folders that hold runs, or runs/NAME for runs/NAME-seed0 and so on."),
    ]
    success: float = 0.9
    """Success rate that a run takes some steps and minutes to."""
    out: Path = Path("runs/comparison")
    """Folder to write to."""
    force: Force = False

    def __call__(self) -> int:
        from rover_rl.algos.experiments.comparison import compare, print_comparison, write_comparison
        from rover_rl.algos.experiments.runs import find_runs

        files = ("comparison.png", "comparison.csv", "runs.csv", "comparison.json")
        check_outputs(*(self.out / file for file in files), force=self.force)
        comparison = compare(find_runs(self.runs), self.success)
        write_comparison(comparison, self.out)
        print_comparison(comparison)
        print(f"Results: {self.out / 'comparison.json'}, comparison.csv, runs.csv")
        print(f"Learning curves: {self.out / 'comparison.png'}")
        return 0
