from __future__ import annotations

import errno
import os
import pickle
import random
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rover_rl.algos.config import PPOConfig
from rover_rl.algos.policy.checkpoint import Checkpoint, load_state, new_run_folder, save_run
from rover_rl.algos.policy.networks import make_actor
from rover_rl.files import errors_name, write_json, written_whole
from tests.full_disk import largest_file


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
    with pytest.raises(FileNotFoundError, match=r"no checkpoint at .*checkpoint\.pt: .* is not the folder of a run"):
        Checkpoint.load(tmp_path)
    (tmp_path / "config.yaml").touch()
    with pytest.raises(FileNotFoundError, match=f"the run has written none yet; .* --resume {tmp_path}$"):
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
    save_run(tmp_path, checkpoint, {"steps": 3})
    assert load_state(tmp_path / "training_state.pt") == {"steps": 3}
    with pytest.raises(ValueError, match="no training state"):
        load_state(tmp_path / "checkpoint.pt")
    with pytest.raises(ValueError, match="no checkpoint"):
        Checkpoint.load(tmp_path / "training_state.pt")


def equal(one: Checkpoint, other: Checkpoint) -> bool:
    rest = [(each.config, each.lidar_points, each.steps, each.actor.keys()) for each in (one, other)]
    return rest[0] == rest[1] and all(torch.equal(one.actor[name], other.actor[name]) for name in one.actor)


def test_a_flipped_bit_is_refused_or_changes_nothing(tmp_path: Path) -> None:
    small = Checkpoint(PPOConfig(hidden=(2,)), 32, 100, make_actor(hidden=(2,)).state_dict())
    path, draw = tmp_path / "checkpoint.pt", random.Random(0)
    small.save(path)
    data = path.read_bytes()
    # Torch takes a record with this bit of its header for a folder, and gives for its content what is in memory.
    folder_bits = [8 * (place + 38) + 4 for place in range(len(data)) if data[place : place + 4] == b"PK\x01\x02"]
    assert folder_bits
    refused = 0
    for bit in [*folder_bits, *draw.sample(range(8 * len(data)), 400)]:
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            assert equal(Checkpoint.load(path), small)
        except ValueError as error:
            assert str(error) == f"{path} is damaged, or no checkpoint of rover_rl"  # noqa: PT017
            refused += 1
    assert refused > 200


def test_a_file_that_was_cut_short_is_refused(checkpoint: Checkpoint, tmp_path: Path) -> None:
    save_run(tmp_path, checkpoint, {"steps": 3})
    for name, load in (("checkpoint.pt", Checkpoint.load), ("training_state.pt", load_state)):
        path = tmp_path / name
        data = path.read_bytes()
        for length in (0, 1, 30, len(data) // 3, len(data) - 1):
            path.write_bytes(data[:length])
            with pytest.raises(ValueError, match="is damaged, or no "):
                load(path)


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(checkpoint: Checkpoint, tmp_path: Path, number: float) -> None:
    name = "module.0.module.body.0.2.weight"
    checkpoint.actor[name][1, 2] = number
    checkpoint.save(tmp_path / "checkpoint.pt")
    with pytest.raises(ValueError, match=f"checkpoint.pt holds NaN or infinity in the policy's weights {name}"):
        Checkpoint.load(tmp_path)


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


@pytest.mark.parametrize("space", [0, 1000, 7000])
def test_without_space_the_last_checkpoint_and_state_stay(checkpoint: Checkpoint, tmp_path: Path, space: int) -> None:
    save_run(tmp_path, checkpoint, {"steps": 100})
    more = {"steps": 200, "memory": torch.zeros(5000)}
    with largest_file(space), pytest.raises(OSError, match="too large") as failure:
        save_run(tmp_path, replace(checkpoint, steps=200), more)
    assert failure.value.errno == errno.EFBIG
    assert failure.value.filename in {str(tmp_path / name) for name in ("checkpoint.pt", "training_state.pt")}
    assert {file.name for file in tmp_path.iterdir()} == {"checkpoint.pt", "training_state.pt"}
    assert equal(Checkpoint.load(tmp_path), checkpoint)
    assert load_state(tmp_path / "training_state.pt") == {"steps": 100}


def test_the_one_that_does_not_fit_is_named_and_neither_is_written(checkpoint: Checkpoint, tmp_path: Path) -> None:
    for name, state in (("checkpoint", {"steps": 1}), ("training_state", {"memory": torch.zeros(5000)})):
        with largest_file(5000), pytest.raises(OSError, match=rf"{tmp_path}/{name}\.pt'$"):
            save_run(tmp_path, checkpoint, state)
        assert not [*tmp_path.iterdir()]


def test_errors_of_writing_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "data.json"
    with largest_file(10), pytest.raises(OSError, match="too large") as failure:
        write_json(path, [*range(1000)])
    assert failure.value.filename == str(path)
    with pytest.raises(IsADirectoryError) as is_folder:
        write_json(tmp_path, [])
    assert is_folder.value.filename == str(tmp_path)
    # A file in the place of a folder is named as it is.
    path.touch()
    with pytest.raises(OSError, match=r"data\.json'$"):
        write_json(path / "more.json", [])
    assert [*tmp_path.iterdir()] == [path]


def test_errors_of_other_kinds_stay_as_they_are(tmp_path: Path) -> None:
    other = FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), "elsewhere")
    for error in (ConnectionError("no cluster"), other):
        with pytest.raises(OSError) as raised, errors_name(tmp_path):
            raise error
        assert raised.value is error
