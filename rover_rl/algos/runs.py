"""What a training run leaves on disk: its folder and its checkpoint."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.modules import ProbabilisticActor

from rover_rl.algos.policy import make_actor

_FORMAT = "rover_rl checkpoint, version 1"


@dataclass(frozen=True)
class Checkpoint:
    """A policy and how it came about.

    Attributes:
        algorithm: that trained it, such as ``"ppo"``.
        config: its settings, plain data.
        lidar_points: readings that the policy sees.
        steps: trained for, 20 Hz steps of one rover.
        actor, critic: weights by name.
    """

    algorithm: str
    config: dict[str, Any]
    lidar_points: int
    steps: int
    actor: dict[str, Tensor]
    critic: dict[str, Tensor]

    def save(self, path: Path) -> None:
        """Writes the checkpoint; a file that was there stays whole until the new one is."""
        with written_whole(path) as temporary:
            torch.save({"format": _FORMAT, **vars(self)}, temporary)

    @classmethod
    def load(cls, path: str | Path) -> Checkpoint:
        """Reads a checkpoint.

        Raises:
            FileNotFoundError: if there is none.
            ValueError: if the file is something else, or damaged.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"no checkpoint at {path}")
        try:
            data = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # a damaged file can fail in any way
            raise ValueError(f"{path} is damaged, or no checkpoint of rover_rl") from error
        if not isinstance(data, dict) or data.pop("format", None) != _FORMAT:
            raise ValueError(f"{path} is no checkpoint of rover_rl")
        return cls(**data)

    def make_actor(self) -> ProbabilisticActor:
        """The policy.

        Raises:
            ValueError: if weights and settings do not belong together.
        """
        hidden = tuple(self.config["hidden"])
        actor = make_actor(self.lidar_points, hidden)
        try:
            actor.load_state_dict(self.actor)
        except RuntimeError as error:
            raise ValueError(f"the checkpoint's weights do not fit hidden={hidden}") from error
        return actor


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` to write to, moved there in the end: nobody sees half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # The suffix stays, because it decides on the format of pictures.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, data: Any) -> None:
    """Writes plain data as JSON."""
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(data, indent=2) + "\n")


def new_run_folder(runs: str | Path, name: str | None, default: str) -> Path:
    """Makes the folder of a new run.

    Args:
        runs: folder of all runs.
        name: of the run; ``None`` takes the first free one of ``default``, ``default-2``, ``default-3``, ...
        default: a name.

    Raises:
        FileExistsError: if there is a run of that name.
        ValueError: for a name that is a path.
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
    raise FileExistsError(f"there is a run {folder} already; choose another name")
