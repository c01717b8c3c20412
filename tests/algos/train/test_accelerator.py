"""On an accelerator, task, collection and learners keep all tensors there, and neither steps nor batches wait for it.

PyTorch gets a simulated device, so that no GPU is needed. Tests on a real one are in tests/gpu.
"""

from __future__ import annotations

import pickle
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import pytest
import torch

from tests.algos.train.accelerated import COLLECTED, LEARNERS, on_both
from tests.fork_server import fork_server

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def found() -> dict[str, Any]:
    # In a separate process, because such a device cannot be removed from PyTorch.
    with ProcessPoolExecutor(1, fork_server()) as pool:
        return pickle.loads(pool.submit(on_both).result())


@pytest.mark.parametrize("learner", COLLECTED)
def test_batches_are_collected_as_on_the_cpu_without_waiting(learner: str, found: dict[str, Any]) -> None:
    (there, looks), (here, _) = found[f"batches of {learner}"]
    assert looks == []
    # With 6 rovers whose episodes take at most 6 decisions.
    assert sum(int(batch["('next', 'done')"].sum()) for batch in here) > 6
    worlds = torch.cat([batch["('outcome', 'world')"] for batch in there], 1)
    assert (worlds.diff(dim=1) != 0).any() == (learner == "pool")
    for a, b in zip(here, there, strict=True):
        assert a.keys() == b.keys()
        for key in a:
            if "clock" in key:
                assert (b[key] == b[key].flatten()[0]).all() or "next" not in key
            else:
                assert torch.equal(a[key], b[key]), key
    times = [batch["('next', 'clock', 'environment')"].max().item() for batch in there]
    assert 0 < times[0] < times[1] < times[2]


@pytest.mark.parametrize("learner", LEARNERS)
def test_a_learner_learns_as_on_the_cpu(learner: str, found: dict[str, Any]) -> None:
    (told_there, weights_there), (told, weights) = found[learner]
    assert told["gradient_steps"] > 0
    assert told == told_there
    for name, value in weights.items():
        assert torch.equal(value, weights_there[name]), name
