from __future__ import annotations

from collections.abc import Iterator

import pytest

from rover_rl.algos.config import training_config
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import make_actor
from tests import fork_server


@pytest.fixture
def checkpoint() -> Checkpoint:
    """A checkpoint with a small network."""
    config = training_config("ppo", hidden=(8,))
    return Checkpoint(config=config, steps=100, actor=make_actor(hidden=(8,)).state_dict())


@pytest.fixture
def quick_workers() -> Iterator[None]:
    """Workers of training runs start quickly: see :func:`tests.fork_server.quick_workers`."""
    with fork_server.quick_workers():
        yield
