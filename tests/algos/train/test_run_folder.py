from __future__ import annotations

import errno
import os
import platform
import time
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest
import torch

from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.train.run_folder import load_state, new_run_folder, save_run, training_lock
from tests.algos.train.runs import equal
from tests.fork_server import fork_server
from tests.full_disk import largest_file


def test_each_run_gets_a_new_folder(tmp_path: Path) -> None:
    assert [new_run_folder(tmp_path, None, "ppo").name for _ in range(3)] == ["ppo", "ppo-2", "ppo-3"]
    assert new_run_folder(tmp_path, "mine", "ppo") == tmp_path / "mine"
    with pytest.raises(FileExistsError, match=r"there is a run .*mine already"):
        new_run_folder(tmp_path, "mine", "ppo")
    with pytest.raises(ValueError, match="name of a folder"):
        new_run_folder(tmp_path, "../elsewhere", "ppo")


def test_a_state_is_no_checkpoint_a_checkpoint_is_no_state_and_truncated_files_raise(
    checkpoint: Checkpoint, tmp_path: Path
) -> None:
    save_run(tmp_path, checkpoint, {"steps": 3})
    assert load_state(tmp_path / "training_state.pt") == {"steps": 3}
    with pytest.raises(ValueError, match="no training state"):
        load_state(tmp_path / "checkpoint.pt")
    with pytest.raises(ValueError, match="no checkpoint"):
        Checkpoint.load(tmp_path / "training_state.pt")
    for name, load in (("checkpoint.pt", Checkpoint.load), ("training_state.pt", load_state)):
        path = tmp_path / name
        data = path.read_bytes()
        for length in (0, 30, len(data) - 1):
            path.write_bytes(data[:length])
            with pytest.raises(ValueError, match="is damaged, or no "):
                load(path)


@pytest.mark.parametrize("space", [0, 7000])
def test_a_full_disk_keeps_the_last_checkpoint_and_state(checkpoint: Checkpoint, tmp_path: Path, space: int) -> None:
    save_run(tmp_path, checkpoint, {"steps": 100})
    more = {"steps": 200, "memory": torch.zeros(5000)}
    with largest_file(space), pytest.raises(OSError, match="too large") as failure:
        save_run(tmp_path, replace(checkpoint, steps=200), more)
    assert failure.value.errno == errno.EFBIG
    assert failure.value.filename in {str(tmp_path / name) for name in ("checkpoint.pt", "training_state.pt")}
    assert {file.name for file in tmp_path.iterdir()} == {"checkpoint.pt", "training_state.pt"}
    assert equal(vars(Checkpoint.load(tmp_path)), vars(checkpoint))
    assert load_state(tmp_path / "training_state.pt") == {"steps": 100}


def hold(folder: Path, told: Connection) -> None:
    """Locks a folder, says so, and holds the lock until the process is killed."""
    with training_lock(folder):
        told.send("locked")
        time.sleep(600)


def test_a_locked_folder_names_the_process_that_trains_there_and_is_free_when_that_is_killed(tmp_path: Path) -> None:
    told, telling = fork_server().Pipe(duplex=False)
    process: Any = fork_server().Process(target=hold, args=(tmp_path, telling))  # type: ignore[attr-defined]
    process.start()
    assert told.recv() == "locked"
    holder = rf"{tmp_path} is being trained by process {process.pid} on {platform.node()}, since \d{{4}}-\d\d-\d\d "
    for _ in range(2):
        with pytest.raises(BlockingIOError, match=holder), training_lock(tmp_path):
            pass
    process.kill()
    process.join()
    with training_lock(tmp_path):
        assert str(os.getpid()) in (tmp_path / "training.lock").read_text()
    assert not [*tmp_path.iterdir()]
