"""Records of training runs that were never trained."""

from __future__ import annotations

import csv
import itertools
from pathlib import Path

from rover_rl.algos.config import TrainingConfig
from rover_rl.algos.config_files import write_config


def write_run(
    folder: Path, config: TrainingConfig, rows: int = 40, parts: int = 1, episodes: int = 6, best: float = 1.0
) -> Path:
    """Writes the files of a run of ``rows`` batches, each as ``parts`` rows of ``progress.csv``.

    Its success rate rises from 0 to ``best``.
    """
    write_config(folder / "config.yaml", config)
    with (folder / "progress.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("minutes", "steps", "goals_per_2000_steps", "attempts", "attempts_reached"))
        for row, part in itertools.product(range(rows), range(1, parts + 1)):
            done = row + part / parts
            goals, reached = row % 7, best * episodes * row / rows / parts
            writer.writerow((done / 10, done * 4096, goals, episodes / parts, reached))
    return folder
