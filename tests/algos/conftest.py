from __future__ import annotations

import pytest

from rover_rl.algos.config import training_config
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import make_actor


@pytest.fixture
def checkpoint() -> Checkpoint:
    """A checkpoint with a small network."""
    config = training_config("ppo", hidden=(8,))
    return Checkpoint(config=config, steps=100, actor=make_actor(hidden=(8,)).state_dict())
