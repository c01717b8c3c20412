"""Folder of a run: its settings, its policy and the state from which training continues."""

from __future__ import annotations

import errno
import os
import platform
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from rover_rl.algos.archives import read_archive, write_archive
from rover_rl.algos.config import TrainingConfig
from rover_rl.algos.config_files import plain_settings, read_sessions, run_config, write_config
from rover_rl.algos.policy.checkpoint import CHECKPOINT, SETTINGS, Checkpoint
from rover_rl.files import check_writable, written_whole
from rover_rl.tasks.task import get_task

STATE = "training_state.pt"  # name of the file in a run's folder from which training continues
_FORMAT = "rover_rl training state, version 2"
CHANGEABLE = (
    *("total_steps", "max_minutes", "learning_rate", "anneal"),
    *("checkpoint_minutes", "snapshots", "logger", "collector", "workers", "device"),
)
"""Settings that may change when a run is continued: its length, its learning rate, what it saves and what computes."""
_PLACE = ("name", "runs")  # settings that say where a run is, which may have been moved
LOCK = "training.lock"  # name of the file in a folder that is locked while a process trains there
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}  # errors of file systems without locks


@contextmanager
def training_lock(folder: Path) -> Iterator[None]:
    """Keeps other processes from training in a folder during the block.

    The operating system releases the lock when this process dies, however it does.

    Raises:
        BlockingIOError: if another process trains there. The message names it.
    """
    path = folder / LOCK
    lock = FileLock(path, blocking=False, fallback_to_soft=False)
    try:
        lock.acquire()
        path.write_text(f"process {os.getpid()} on {platform.node()}, since {datetime.now():%Y-%m-%d %H:%M:%S}")
    except Timeout:
        holder = ""
        with suppress(OSError):
            holder = path.read_text()
        raise BlockingIOError(
            f"{folder} is being trained by {holder or 'another process'}; wait until that ends, or stop it with "
            "Ctrl-C or SIGTERM, which saves a checkpoint"
        ) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        warnings.warn(f"{folder} is on a file system without locks: run no other training in it", stacklevel=3)
    try:
        yield
    finally:
        # Only the holder removes the file. Whoever has opened it meanwhile finds out that it has no name anymore.
        with suppress(OSError):
            path.unlink()
        lock.release()


def save_run(folder: Path, checkpoint: Checkpoint, state: dict[str, Any]) -> None:
    """Writes a run's policy and training state. The old files remain until both new files are complete."""
    # The state is renamed first: a run that is killed before the checkpoint is renamed can still be resumed.
    with written_whole(folder / CHECKPOINT) as new_checkpoint, written_whole(folder / STATE) as new_state:
        write_archive(new_state, _FORMAT, state)
        checkpoint.write(new_checkpoint)


def load_state(path: Path) -> dict[str, Any]:
    return read_archive(path, _FORMAT, "training state")


def default_name(config: TrainingConfig) -> str:
    memory = [] if config.network.memory == "none" else [config.network.memory]
    named = (get_task(config.run.task_name).name,) if config.run.task_name else config.env.world_names
    name = "-".join((config.algo, *memory, *named)).replace("*", "all")
    return re.sub(r"[:/\\]+", "-", name)


def new_run_folder(runs: str | Path, name: str | None, default: str) -> Path:
    """Creates the folder of a new run: ``name``, or the first of ``default``, ``default-2`` and so on that is free."""
    if name is not None and Path(name).name != name:
        raise ValueError(f"name must be the name of a folder, got {name!r}")
    for candidate in [name] if name is not None else (default if i == 1 else f"{default}-{i}" for i in count(1)):
        folder = Path(runs) / candidate
        check_writable(folder, "--runs")
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            continue
    raise FileExistsError(
        f"there is a run {folder} already; choose another name, or continue it with --resume {folder}"
    )


@dataclass
class RunRecord:
    """Settings in the ``config.yaml`` of a run, with its ``sessions`` that changed some.

    Each has ``from_step``, the number of steps that the run had, and ``changed``, the new values by name. ``changed``
    are old and new values that this session changes, by name.
    """

    path: Path
    config: TrainingConfig
    sessions: list[dict[str, Any]] = field(default_factory=list)
    changed: dict[str, tuple[Any, Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path, config: TrainingConfig) -> RunRecord:
        """Reads the record of a run, which is continued with the settings ``config``."""
        before, now = plain_settings(run_config(folder)), plain_settings(config)
        changed = {
            name: (before.get(name), now.get(name))
            for name in dict.fromkeys((*before, *now))
            if name not in _PLACE and before.get(name) != now.get(name)
        }
        if refused := [name for name in changed if name not in CHANGEABLE]:
            trained = ", ".join(f"{name}={changed[name][0]!r}" for name in refused)
            raise ValueError(
                f"{folder} is trained with {trained}, and a run that is continued keeps it (only "
                f"{', '.join(CHANGEABLE)} may change); for a new run that starts from its policy, use --from {folder}"
            )
        return cls(folder / SETTINGS, config, read_sessions(folder / SETTINGS), changed)

    def begin(self) -> None:
        self.changed = {}
        write_config(self.path, self.config, self.sessions)

    def trained(self, from_step: int) -> None:
        """Writes the settings of this session if they differ from those before, once it has trained."""
        if self.changed:
            new = {name: value for name, (_, value) in self.changed.items()}
            self.sessions = [*self.sessions, {"from_step": from_step, "changed": new}]
            self.changed = {}
            write_config(self.path, self.config, self.sessions)

    def __str__(self) -> str:
        return ", ".join(f"{name}={new} (before: {old})" for name, (old, new) in self.changed.items())
