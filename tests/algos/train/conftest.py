from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from shutil import copytree

import pytest

from rover_rl.algos.config import TrainingConfig, with_settings
from rover_rl.algos.train import train
from rover_rl.algos.train.run import TrainingSummary
from tests.algos.train.runs import PPO, SAC


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], TrainingSummary]:
    """Returns the finished run of the small training with an algorithm. Tests only read its folder."""

    @cache
    def run(algo: str) -> TrainingSummary:
        config = {"ppo": PPO, "sac": SAC}[algo]
        return train(with_settings(config, runs=str(tmp_path_factory.mktemp("trained"))))

    return run


@pytest.fixture
def own_run(trained: Callable[[str], TrainingSummary], tmp_path: Path) -> Callable[[TrainingConfig], Path]:
    """Copies the folder of the small training, so that a test can change it or continue its run."""

    def copied(config: TrainingConfig) -> Path:
        folder = trained(config.algo).folder
        return Path(copytree(folder, tmp_path / folder.name))

    return copied
