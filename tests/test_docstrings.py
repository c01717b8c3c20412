"""The examples of docstrings run and give what they say. Here are those that take little time."""

from __future__ import annotations

import doctest
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest

import rover_rl
import rover_rl.envs
from rover_rl.algos.config import TrainingConfig, training_config
from rover_rl.algos.policy.checkpoint import CHECKPOINT
from rover_rl.algos.train.run_folder import default_name

KNOWN = {name: getattr(module, name) for module in (rover_rl.envs, rover_rl) for name in module.__all__} | {
    "training_config": training_config,
}
"""Names that examples use without importing them, besides those of their module."""
QUICK = [
    *("algos.config", "algos.config_files", "algos.evaluation.metrics", "algos.experiments.statistics"),
    *("algos.train.fine_tuning", "algos.train.learnability", "envs.devices", "envs.goal_pay"),
    *("envs.sensors.lidar", "registry"),
    *("sims.robots.footprint", "sims.ros2.limits"),
]


def run(name: str, **instead: object) -> None:
    module = import_module(f"rover_rl.{name}")
    found = doctest.DocTestFinder(exclude_empty=True).find(module, globs={**KNOWN, **vars(module), **instead})
    examples = [test for test in found if test.examples]
    assert examples
    for test in examples:
        told: list[str] = []
        flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
        assert not doctest.DocTestRunner(optionflags=flags).run(test, out=told.append).failed, "".join(told)


@pytest.mark.parametrize("name", QUICK)
def test_examples_run(name: str) -> None:
    run(name)


def test_the_example_of_training_calls_it_as_it_is_called() -> None:
    def trained(config: TrainingConfig, folder: Path | None = None) -> SimpleNamespace:
        config.check()
        return SimpleNamespace(checkpoint=Path(config.run.runs) / default_name(config) / CHECKPOINT)

    run("algos.train", train=trained)
