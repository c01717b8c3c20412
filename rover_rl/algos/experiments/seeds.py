"""Training runs that differ in their seed only, each in a folder of its own: ``NAME-seed0``, ``NAME-seed1``, ..."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rover_rl.algos.config import TrainingConfig, with_settings
from rover_rl.algos.config_files import SEED_SUFFIX, differing_settings, run_config
from rover_rl.algos.train.run_folder import default_name


def seed_runs(config: TrainingConfig, seeds: Sequence[int]) -> list[tuple[TrainingConfig, Path | None]]:
    """Returns the settings of a run for each seed, and the folder of the run if it exists, to continue it.

    So an interrupted experiment goes on where it was when it is started again. A run that exists keeps its own settings
    where these do not change what is learned, such as its backend. The name in ``config``, by default that of a single
    run, such as ``ppo-moon``, is the first part of the folders' names.

    Raises:
        ValueError: for no or repeated seeds, or a setting out of range.
        FileExistsError: if there is a run of that name with other settings.
    """
    if not seeds or len(set(seeds)) < len(seeds):
        raise ValueError(f"seeds must be at least one, each once, got {tuple(seeds)}")
    name = config.run.name or default_name(config)
    runs: list[tuple[TrainingConfig, Path | None]] = []
    for seed in seeds:
        run = with_settings(config, seed=seed, name=f"{name}{SEED_SUFFIX}{seed}")
        run.check()
        runs.append(continued(run))
    return runs


def continued(config: TrainingConfig) -> tuple[TrainingConfig, Path | None]:
    """Returns the settings and the folder of the run that ``config`` names; ``None`` if it does not exist yet."""
    folder = Path(config.run.runs, config.run.name or "")
    if not folder.exists():
        return config, None
    saved = run_config(folder)
    if others := differing_settings(config, saved):
        raise FileExistsError(
            f"there is a run {folder} already, with other settings of {', '.join(others)}; choose another --name"
        )
    return saved, folder
