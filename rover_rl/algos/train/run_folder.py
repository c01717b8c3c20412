"""Folder of a run, with its policy and the state from which training continues."""

from __future__ import annotations

import re
from itertools import count
from pathlib import Path
from typing import Any

from rover_rl.algos.archives import read_archive, write_archive
from rover_rl.algos.config import TrainingConfig
from rover_rl.algos.policy.checkpoint import CHECKPOINT, Checkpoint
from rover_rl.files import written_whole

STATE = "training_state.pt"
"""Name of the file in a run's folder from which training continues."""
_FORMAT = "rover_rl training state, version 2"


def save_run(folder: Path, checkpoint: Checkpoint, state: dict[str, Any]) -> None:
    """Writes a run's policy and training state. The old files remain until both new files are complete."""
    # The state is renamed first: a run that is killed before the checkpoint is renamed can still be resumed.
    with written_whole(folder / CHECKPOINT) as new_checkpoint, written_whole(folder / STATE) as new_state:
        write_archive(new_state, _FORMAT, state)
        checkpoint.write(new_checkpoint)


def load_state(path: Path) -> dict[str, Any]:
    """Reads the training state that :func:`save_run` wrote. Nothing in the file is executed.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is no training state, or damaged.
    """
    return read_archive(path, _FORMAT, "training state")


def default_name(config: TrainingConfig) -> str:
    """Returns the default name of a run: the algorithm and the worlds, such as ``ppo-moon``."""
    name = "-".join((config.algo, *config.env.world_names)).replace("*", "all")
    return re.sub(r"[:/\\]+", "-", name)


def new_run_folder(runs: str | Path, name: str | None, default: str) -> Path:
    """Creates the folder of a new run.

    Args:
        runs: folder of all runs.
        name: name of the run; ``None``: the first unused of ``default``, ``default-2``, ``default-3``, ...
        default: default name.

    Raises:
        FileExistsError: if a run of that name exists.
        ValueError: if the name is a path.
    """
    if name is not None and Path(name).name != name:
        raise ValueError(f"name must be the name of a folder, got {name!r}")
    names = [name] if name is not None else (default if i == 1 else f"{default}-{i}" for i in count(1))
    for candidate in names:
        folder = Path(runs) / candidate
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        return folder
    raise FileExistsError(
        f"there is a run {folder} already; choose another name, or continue it with --resume {folder}"
    )
