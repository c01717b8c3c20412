from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rover_rl.algos.config import PPOConfig
from rover_rl.algos.files import written_whole
from rover_rl.algos.policy import make_actor
from rover_rl.algos.runs import Checkpoint, load_state, new_run_folder, save_state


@pytest.fixture
def checkpoint() -> Checkpoint:
    config = PPOConfig(hidden=(8,))
    return Checkpoint(config=config, lidar_points=32, steps=100, actor=make_actor(hidden=(8,)).state_dict())


def test_a_checkpoint_comes_back_as_it_was(checkpoint: Checkpoint, tmp_path: Path) -> None:
    path = tmp_path / "run" / "checkpoint.pt"
    checkpoint.save(path)
    for given in (path, str(path), path.parent):
        loaded = Checkpoint.load(given)
        assert (loaded.algorithm, loaded.config, loaded.steps) == ("ppo", checkpoint.config, 100)
        weights = loaded.make_actor().state_dict()
        assert all(torch.equal(weights[key], value) for key, value in checkpoint.actor.items())
    assert [file.name for file in path.parent.iterdir()] == ["checkpoint.pt"]


def test_a_missing_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no checkpoint at .*nothing\.pt"):
        Checkpoint.load(tmp_path / "nothing.pt")
    with pytest.raises(FileNotFoundError, match=r"no checkpoint at .*checkpoint\.pt"):
        Checkpoint.load(tmp_path)


class Malicious:
    """Would write a file if it were unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.path,)


def test_foreign_and_damaged_files_are_refused_and_nothing_is_executed(checkpoint: Checkpoint, tmp_path: Path) -> None:
    whole, path, harm = tmp_path / "whole.pt", tmp_path / "file.pt", tmp_path / "harm"
    checkpoint.save(whole)
    data = whole.read_bytes()
    contents = [b"", b"some text", pickle.dumps(Malicious(harm)), data[: len(data) // 2], data[1000:]]
    for foreign in ({"weights": torch.zeros(3)}, {"format": "another"}, Malicious(harm), [1, 2]):
        torch.save(foreign, path)
        contents.append(path.read_bytes())
    for content in contents:
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"file\.pt is .*no checkpoint of"):
            Checkpoint.load(path)
        with pytest.raises(ValueError, match=r"file\.pt is .*no training state of"):
            load_state(path)
    assert not harm.exists()


def test_a_state_is_no_checkpoint_and_the_other_way_round(checkpoint: Checkpoint, tmp_path: Path) -> None:
    checkpoint.save(tmp_path / "checkpoint.pt")
    save_state(tmp_path / "state.pt", {"steps": 3})
    assert load_state(tmp_path / "state.pt") == {"steps": 3}
    with pytest.raises(ValueError, match="no training state"):
        load_state(tmp_path / "checkpoint.pt")
    with pytest.raises(ValueError, match="no checkpoint"):
        Checkpoint.load(tmp_path / "state.pt")


def test_weights_that_do_not_fit_are_refused(checkpoint: Checkpoint) -> None:
    with pytest.raises(ValueError, match="do not fit"):
        replace(checkpoint, config=PPOConfig(hidden=(16,))).make_actor()


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
