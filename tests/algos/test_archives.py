from __future__ import annotations

import pickle
import random
from pathlib import Path

import pytest
import torch

from rover_rl.algos.archives import first_not_finite, read_archive, write_archive
from rover_rl.algos.config import training_config
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import make_actor
from rover_rl.algos.train.run_folder import load_state
from tests.algos.train.runs import equal


def test_an_archive_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "archive.pt"
    write_archive(path, "form 2", {"steps": 3, "weights": {"a": torch.arange(4.0)}})
    data = read_archive(path, "form 2", "archive")
    assert data["steps"] == 3
    assert torch.equal(data["weights"]["a"], torch.arange(4.0))


@pytest.mark.parametrize("number", [float("nan"), -float("inf")])
def test_the_first_tensor_that_is_not_finite_is_found(number: float) -> None:
    whole = {"a": torch.zeros(2), "b": torch.ones(3)}
    assert first_not_finite({}) is None
    assert first_not_finite(whole) is None
    assert first_not_finite({**whole, "c": torch.tensor([0.0, number]), "d": torch.tensor(number)}) == "c"


class Malicious:
    """Would write a file if it were unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.path,)


def test_foreign_and_damaged_files_raise_and_nothing_is_executed(checkpoint: Checkpoint, tmp_path: Path) -> None:
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


def test_a_flipped_bit_raises_or_changes_nothing(tmp_path: Path) -> None:
    small = Checkpoint(training_config("ppo", hidden=(2,)), 100, make_actor(hidden=(2,)).state_dict())
    path, draw = tmp_path / "checkpoint.pt", random.Random(0)
    small.save(path)
    data = path.read_bytes()
    # Torch takes a record with this bit of its header for a folder, and gives for its content what is in memory.
    folder_bits = [8 * (place + 38) + 4 for place in range(len(data)) if data[place : place + 4] == b"PK\x01\x02"]
    assert folder_bits
    refused = 0
    for bit in [*folder_bits, *draw.sample(range(8 * len(data)), 100)]:
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            assert equal(vars(Checkpoint.load(path)), vars(small))
        except ValueError as error:
            assert str(error) == f"{path} is damaged, or no checkpoint of rover_rl"  # noqa: PT017
            refused += 1
    assert refused > 50
