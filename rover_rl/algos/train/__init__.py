"""Training: PPO, SAC, and what they share.

Example:
    >>> summary = train(training_config("ppo", world="maze", max_minutes=5))
    >>> summary.checkpoint
    PosixPath('runs/ppo-maze/checkpoint.pt')
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from rover_rl.algos.config import TrainingConfig, training_config

if TYPE_CHECKING:
    from rover_rl.algos.train.run import TrainingSummary

__all__ = ["train", "training_config"]


def train(config: TrainingConfig, folder: Path | None = None) -> TrainingSummary:
    """Trains a policy with the algorithm of ``config``.

    Args:
        config: settings of the training.
        folder: folder of a run to continue; ``None`` begins a new one.

    Raises:
        ValueError: for a setting out of range, or an unknown world, robot, reward or backend.
        FileExistsError: if there is a run of that name.
    """
    module = import_module(f"{__name__}.{config.algo}")
    return getattr(module, f"train_{config.algo}")(config, folder)
