from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from shutil import copytree

import pytest

from rover_rl.algos.config import TrainingConfig
from rover_rl.algos.train.run import TrainingSummary
from tests.algos.train.runs import PPO, SAC, run


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], TrainingSummary]:
    """Returns the finished run of the small training with an algorithm. Tests only read its folder."""
    return cache(lambda algo: run({"ppo": PPO, "sac": SAC}[algo], tmp_path_factory.mktemp("trained")))


@pytest.fixture
def own_run(trained: Callable[[str], TrainingSummary], tmp_path: Path) -> Callable[[TrainingConfig], Path]:
    """Copies the folder of the small training, so that a test can change it or continue its run."""

    def copied(config: TrainingConfig) -> Path:
        folder = trained(config.algo).folder
        return Path(copytree(folder, tmp_path / folder.name))

    return copied
