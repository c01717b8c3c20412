from __future__ import annotations

import pickle
from pathlib import Path

import pytest
import torch

from rover_rl.algos.policy import make_actor, make_critic
from rover_rl.algos.runs import Checkpoint, new_run_folder, written_whole


@pytest.fixture
def checkpoint() -> Checkpoint:
    return Checkpoint(
        algorithm="ppo",
        config={"world": "maze", "hidden": (8,)},
        lidar_points=32,
        steps=100,
        actor=make_actor(32, (8,)).state_dict(),
        critic=make_critic(32, (8,)).state_dict(),
    )


def test_a_checkpoint_comes_back_as_it_was(checkpoint: Checkpoint, tmp_path: Path) -> None:
    path = tmp_path / "run" / "checkpoint.pt"
    checkpoint.save(path)
    loaded = Checkpoint.load(path)
    assert (loaded.algorithm, loaded.config, loaded.steps) == ("ppo", checkpoint.config, 100)
    weights = loaded.make_actor().state_dict()
    assert all(torch.equal(weights[key], value) for key, value in checkpoint.actor.items())
    assert [file.name for file in path.parent.iterdir()] == ["checkpoint.pt"]


def test_a_missing_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no checkpoint at .*nothing\.pt"):
        Checkpoint.load(tmp_path / "nothing.pt")


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
def test_foreign_and_damaged_files_are_refused(checkpoint: Checkpoint, tmp_path: Path) -> None:
    whole, path = tmp_path / "whole.pt", tmp_path / "file.pt"
    checkpoint.save(whole)
    data = whole.read_bytes()
    torch.save({"weights": torch.zeros(3)}, path)
    foreign = path.read_bytes()
    for content in (b"", b"some text", foreign, pickle.dumps(Path), data[: len(data) // 2], data[1000:]):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"file\.pt is .*no checkpoint of rover_rl"):
            Checkpoint.load(path)


def test_weights_that_do_not_fit_are_refused(checkpoint: Checkpoint, tmp_path: Path) -> None:
    checkpoint.config["hidden"] = (16,)
    checkpoint.save(tmp_path / "file.pt")
    with pytest.raises(ValueError, match="do not fit"):
        Checkpoint.load(tmp_path / "file.pt").make_actor()


def test_runs_get_folders_of_their_own(tmp_path: Path) -> None:
    assert [new_run_folder(tmp_path, None, "ppo").name for _ in range(3)] == ["ppo", "ppo-2", "ppo-3"]
    assert new_run_folder(tmp_path, "mine", "ppo") == tmp_path / "mine"
    with pytest.raises(FileExistsError, match=r"there is a run .*mine already"):
        new_run_folder(tmp_path, "mine", "ppo")
    with pytest.raises(ValueError, match="name of a folder"):
        new_run_folder(tmp_path, "../elsewhere", "ppo")


def test_half_a_file_is_never_seen(tmp_path: Path) -> None:
    path = tmp_path / "data.json"
    path.write_text("old")

    def fail() -> None:
        with written_whole(path) as temporary:
            temporary.write_text("ne")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
