from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rover_rl.algos.config import training_config
from rover_rl.algos.policy.checkpoint import Checkpoint


def test_a_checkpoint_is_loaded_as_it_was_saved(checkpoint: Checkpoint, tmp_path: Path) -> None:
    path = tmp_path / "run" / "checkpoint.pt"
    checkpoint.save(path)
    for given in (path, str(path), path.parent):
        loaded = Checkpoint.load(given)
        assert (loaded.config, loaded.steps) == (checkpoint.config, 100)
        weights = loaded.make_actor().state_dict()
        assert all(torch.equal(weights[key], value) for key, value in checkpoint.actor.items())
    assert [file.name for file in path.parent.iterdir()] == ["checkpoint.pt"]


def test_the_error_names_a_missing_checkpoint(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no checkpoint at .*nothing\.pt"):
        Checkpoint.load(tmp_path / "nothing.pt")
    with pytest.raises(FileNotFoundError, match=r"no checkpoint at .*checkpoint\.pt: .* is not the folder of a run"):
        Checkpoint.load(tmp_path)
    (tmp_path / "config.yaml").touch()
    with pytest.raises(FileNotFoundError, match=f"the run has written none yet; .* --resume {tmp_path}$"):
        Checkpoint.load(tmp_path)


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_raise(checkpoint: Checkpoint, tmp_path: Path, number: float) -> None:
    name = "module.0.module.body.0.2.weight"
    checkpoint.actor[name][1, 2] = number
    checkpoint.save(tmp_path / "checkpoint.pt")
    with pytest.raises(ValueError, match=f"checkpoint.pt holds NaN or infinity in the policy's weights {name}"):
        Checkpoint.load(tmp_path)


def test_weights_of_another_network_raise(checkpoint: Checkpoint) -> None:
    with pytest.raises(ValueError, match="do not fit"):
        replace(checkpoint, config=training_config("ppo", hidden=(16,))).make_actor()
