"""On an accelerator, the task and the learners keep all tensors there, and no step waits for it.

PyTorch gets a simulated device, so that no GPU is needed. Tests on a real one are in tests/sims/warp/test_gpu.py.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from typing import Any

import pytest
import torch

from tests.algos.train.accelerated import LEARNERS, on_both
from tests.fork_server import fork_server


@pytest.fixture(scope="module")
def found() -> dict[str, Any]:
    # In a separate process, because such a device cannot be removed from PyTorch.
    with ProcessPoolExecutor(1, fork_server()) as pool:
        return pool.submit(on_both).result()


@pytest.mark.parametrize("part", ["steps", "changes"])
def test_an_environment_steps_as_on_the_cpu(part: str, found: dict[str, Any]) -> None:
    there, here = found[part]
    for step, (a, b) in enumerate(zip(here, there, strict=True)):
        assert a.keys() == b.keys()
        for key in a:
            assert torch.equal(a[key], b[key]), (step, key)


def test_a_step_does_not_wait_for_the_accelerator(found: dict[str, Any]) -> None:
    assert found["looks"] == []


def test_a_change_of_worlds_does_not_wait_for_the_accelerator(found: dict[str, Any]) -> None:
    assert found["looks of changes"] == []
    worlds = torch.cat([seen["('outcome', 'world')"] for seen in found["changes"][0]], -1)
    assert (worlds.diff() != 0).any(-1).all()


@pytest.mark.parametrize("learner", LEARNERS)
def test_a_learner_learns_as_on_the_cpu(learner: str, found: dict[str, Any]) -> None:
    (told_there, weights_there), (told, weights) = found[learner]
    assert told["gradient_steps"] > 0
    assert told == told_there
    for name, value in weights.items():
        assert torch.equal(value, weights_there[name]), name
