"""Nothing of the task and of the learners is left on the CPU when they are on a GPU, and nothing of ours waits for it.

There needs not be one: PyTorch is given a device that only pretends to be elsewhere. Real ones are in
tests/sims/warp/test_gpu.py.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import pytest
import torch

from tests.algos.train.accelerated import LEARNERS, on_both


@pytest.fixture(scope="module")
def found() -> dict[str, Any]:
    # In a process of its own: PyTorch has such a device once and for all.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(on_both).result()


def test_an_environment_drives_there_as_on_the_cpu(found: dict[str, Any]) -> None:
    there, here = found["steps"]
    for step, (a, b) in enumerate(zip(here, there, strict=True)):
        assert a.keys() == b.keys()
        for key in a:
            assert torch.equal(a[key], b[key]), (step, key)


def test_a_step_waits_for_nothing(found: dict[str, Any]) -> None:
    assert found["looks"] == []


@pytest.mark.parametrize("learner", LEARNERS)
def test_a_learner_learns_there_what_it_does_on_the_cpu(learner: str, found: dict[str, Any]) -> None:
    (told_there, weights_there), (told, weights) = found[learner]
    assert told["gradient_steps"] > 0
    assert told == told_there
    for name, value in weights.items():
        assert torch.equal(value, weights_there[name]), name
