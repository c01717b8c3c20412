"""What a training run leaves on disk: its folder, the policies in it, and the state to go on from."""

from __future__ import annotations

import io
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.modules import ProbabilisticActor

from rover_rl.algos.config import TrainingConfig, config_from, plain
from rover_rl.algos.policy.networks import ObservationEncoder, make_actor
from rover_rl.files import write_through, written_whole

SETTINGS, CHECKPOINT, STATE = "config.yaml", "checkpoint.pt", "training_state.pt"
"""Files in the folder of a run: its settings, the policy, and all that the training needs to go on."""
_CHECKPOINT_FORMAT = "rover_rl checkpoint, version 3"
_STATE_FORMAT = "rover_rl training state, version 2"


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
        with written_whole(path) as temporary:
            self._write(temporary)

    def _write(self, path: Path) -> None:
        _write(path, {"format": _CHECKPOINT_FORMAT, **vars(self), "config": plain(self.config)})

    @classmethod
    def load(cls, path: str | Path) -> Checkpoint:
        """Reads a checkpoint, or the one of a run's folder. Nothing in the file is executed.

        Raises:
            FileNotFoundError: if there is none.
            ValueError: if the file is something else, or damaged, or holds weights that are not finite.
        """
        path = Path(path)
        path = path / CHECKPOINT if path.is_dir() else path
        if path.name == CHECKPOINT and not path.exists():
            raise FileNotFoundError(f"no checkpoint at {path}: {_why_none(path.parent)}")
        data = _load(path, _CHECKPOINT_FORMAT, "checkpoint")
        try:
            checkpoint = cls(config=config_from(data.pop("config"), str(path)), **data)
            infected = first_not_finite(checkpoint.actor)
        except (AttributeError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is a damaged checkpoint: {error}") from error
        if infected is not None:
            raise ValueError(f"{path} holds NaN or infinity in the policy's weights {infected}: it cannot drive")
        return checkpoint

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


def save_run(folder: Path, checkpoint: Checkpoint, state: dict[str, Any]) -> None:
    """Writes a run's policy and its training state; the old ones stay until both new ones are written."""
    # The state is moved first: a run that is killed before the checkpoint is can still go on.
    with written_whole(folder / CHECKPOINT) as new_checkpoint, written_whole(folder / STATE) as new_state:
        _write(new_state, {"format": _STATE_FORMAT, **state})
        checkpoint._write(new_checkpoint)


def load_state(path: Path) -> dict[str, Any]:
    """Reads the training state that :func:`save_run` wrote. Nothing in the file is executed.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if the file is something else, or damaged.
    """
    return _load(path, _STATE_FORMAT, "training state")


def first_not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """Name of the first tensor that holds NaN or infinity; ``None`` if all are finite."""
    if not tensors:
        return None
    # One look at all of them: each look waits for a GPU.
    finite = torch.stack([tensor.isfinite().all() for tensor in tensors.values()]).tolist()
    return next((name for name, whole in zip(tensors, finite, strict=True) if not whole), None)


def checked_copy(archive: bytes) -> io.BytesIO:
    """A file that torch wrote, each record of it compared with its checksum, which torch itself does not do.

    The copy has new headers: of a record whose header is damaged, torch may give what happens to be in memory.

    Raises:
        zipfile.BadZipFile: for a difference, or no such file; a damaged one may raise other errors, too.
    """
    copy = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as records, zipfile.ZipFile(copy, "w") as checked:
        for record in records.infolist():
            checked.writestr(record.filename, records.read(record))
    copy.seek(0)
    return copy


def _write(path: Path, data: dict[str, Any]) -> None:
    # In memory first: on a full disk torch's own writer fails with errors that do not say so.
    written = io.BytesIO()
    torch.save(data, written)
    write_through(path, written.getbuffer())


def _load(path: Path, form: str, kind: str) -> dict[str, Any]:
    if not path.is_file():
        raise FileNotFoundError(f"no {kind} at {path}")
    content = path.read_bytes()
    try:
        with warnings.catch_warnings():
            # A pickle that is none of torch's warns of itself before it fails.
            warnings.simplefilter("ignore")
            data = torch.load(checked_copy(content), map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file can fail in any way
        raise ValueError(f"{path} is damaged, or no {kind} of rover_rl") from error
    if not isinstance(data, dict) or data.pop("format", None) != form:
        raise ValueError(f"{path} is no {kind} of this version of rover_rl")
    return data


def _why_none(folder: Path) -> str:
    """Why a folder has no checkpoint, and what to do about it."""
    if not (folder / SETTINGS).is_file():
        return f"{folder} is not the folder of a run"
    return f"the run has written none yet; if it has ended, go on with rover-rl train --resume {folder}"


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
