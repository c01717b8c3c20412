"""The command ``rover-rl compare``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from rover_rl.cli.evaluate import Evaluate
from rover_rl.cli.options import Force, is_bag
from rover_rl.files import check_outputs
from rover_rl.sims.ros2.settings import BAG, BagTopics


@dataclass(frozen=True)
class Compare:
    """Compare training runs by their learning curves, over several seeds, or recorded drives.

    Of runs, writes comparison.png, comparison.csv, runs.csv and comparison.json; of bags, the files and the table of
    rover-rl evaluate, which also takes their world, and policies beside them.
    """

    runs: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(
            metavar="RUN|BAG ...",
            help="Folders of runs, folders that hold runs, or runs/NAME for runs/NAME-seed0 and so on; or bags of "
            f"drives, {BAG} files.",
        ),
    ]
    success: float = 0.9
    """Success rate that a run takes some steps and minutes to."""
    out: Path = Path("runs/comparison")
    """Folder to write to."""
    force: Force = False
    topics: BagTopics = field(default_factory=BagTopics)

    def __call__(self) -> int:
        from rover_rl.algos.experiments.comparison import compare, print_comparison, write_comparison
        from rover_rl.algos.experiments.runs import find_runs

        bags = [name for name in self.runs if is_bag(name)]
        if bags:
            if others := [name for name in self.runs if name not in bags]:
                raise ValueError(f"{others[0]} is no bag, and {bags[0]} is one: compare runs or bags")
            return Evaluate(policies=self.runs, out=self.out, force=self.force, topics=self.topics)()
        files = ("comparison.png", "comparison.csv", "runs.csv", "comparison.json")
        check_outputs(*(self.out / file for file in files), force=self.force)
        comparison = compare(find_runs(self.runs), self.success)
        write_comparison(comparison, self.out)
        print_comparison(comparison)
        print(f"Results: {self.out / 'comparison.json'}, comparison.csv, runs.csv")
        print(f"Learning curves: {self.out / 'comparison.png'}")
        return 0
