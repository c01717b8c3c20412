"""What a training run leaves on disk: its folder, the policies in it, and the state to go on from."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.modules import ProbabilisticActor

from rover_rl.algos.config import TrainingConfig, config_from, plain
from rover_rl.algos.files import written_whole
from rover_rl.algos.policy import ObservationEncoder, make_actor

_CHECKPOINT = "rover_rl checkpoint, version 3"
_STATE = "rover_rl training state, version 2"


@dataclass(frozen=True)
class Checkpoint:
    """A policy and how it came about.

    Attributes:
        config: settings that it was trained with.
        lidar_points: readings that it sees.
        steps: it was trained for, 20 Hz steps of one rover.
        actor: weights by name.
    """

    config: TrainingConfig
    lidar_points: int
    steps: int
    actor: dict[str, Tensor]

    @property
    def algorithm(self) -> str:
        """That trained it, such as ``"ppo"``."""
        return self.config.algo

    def save(self, path: Path) -> None:
        """Writes the checkpoint; a file that was there stays whole until the new one is."""
        _save(path, {"format": _CHECKPOINT, **vars(self), "config": plain(self.config)})

    @classmethod
    def load(cls, path: str | Path) -> Checkpoint:
        """Reads a checkpoint, or the one of a run's folder. Nothing in the file is executed.

        Raises:
            FileNotFoundError: if there is none.
            ValueError: if the file is something else, or damaged.
        """
        path = Path(path)
        path = path / "checkpoint.pt" if path.is_dir() else path
        data = _load(path, _CHECKPOINT, "checkpoint")
        try:
            config = config_from(data.pop("config"), str(path))
            return cls(config=config, **data)
        except (KeyError, TypeError) as error:
            raise ValueError(f"{path} is a damaged checkpoint: {error}") from error

    def make_actor(self) -> ProbabilisticActor:
        """The policy.

        Raises:
            ValueError: if weights and settings do not belong together.
        """
        config = self.config
        encoder = ObservationEncoder(config.observation, self.lidar_points, config.north_up)
        actor = make_actor(encoder, config.hidden, config.reverse, config.spread)
        try:
            actor.load_state_dict(self.actor)
        except RuntimeError as error:
            raise ValueError(f"the checkpoint's weights do not fit hidden={config.hidden}") from error
        return actor


def save_state(path: Path, state: dict[str, Any]) -> None:
    """Writes all that a training needs to go on; a file that was there stays whole until the new one is."""
    _save(path, {"format": _STATE, **state})


def load_state(path: Path) -> dict[str, Any]:
    """Reads what :func:`save_state` wrote. Nothing in the file is executed.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if the file is something else, or damaged.
    """
    return _load(path, _STATE, "training state")


def _save(path: Path, data: dict[str, Any]) -> None:
    with written_whole(path) as temporary:
        torch.save(data, temporary)


def _load(path: Path, form: str, kind: str) -> dict[str, Any]:
    if not path.is_file():
        raise FileNotFoundError(f"no {kind} at {path}")
    try:
        with warnings.catch_warnings():
            # A pickle that is none of torch's warns of itself before it fails.
            warnings.simplefilter("ignore")
            data = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file can fail in any way
        raise ValueError(f"{path} is damaged, or no {kind} of rover_rl") from error
    if not isinstance(data, dict) or data.pop("format", None) != form:
        raise ValueError(f"{path} is no {kind} of this version of rover_rl")
    return data


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
    raise FileExistsError(f"there is a run {folder} already; choose another name, or go on with --resume {folder}")
