"""Training with PPO and SAC.

Example:
    >>> summary = train(training_config("ppo", world="maze", total_steps=20_000))
    >>> summary.checkpoint
    PosixPath('runs/ppo-maze/checkpoint.pt')
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rover_rl.algos.config import TrainingConfig, training_config
from rover_rl.progress import ProgressDisplay

if TYPE_CHECKING:
    from rover_rl.algos.train.run import TrainingSummary

__all__ = ["train", "training_config"]


def train(
    config: TrainingConfig, folder: Path | None = None, begun: Callable[[Path], Any] | None = None
) -> TrainingSummary:
    """Trains a policy with the algorithm of ``config``.

    Args:
        config: settings of the training run.
        folder: folder of a run to continue; ``None`` starts a new run.
        begun: function that is called with the folder of the run before the first step.

    Raises:
        ValueError: for a setting out of range, or an unknown world, robot, reward or backend.
        FileExistsError: if a run of that name exists.
    """
    # These import PyTorch.
    from rover_rl.algos.policy.networks import single_threaded, with_threads
    from rover_rl.algos.train.run import TrainingRun, prepare

    learner_type = getattr(import_module(f"{__name__}.{config.algo}"), f"{config.algo.upper()}Learner")
    with single_threaded():
        with ProgressDisplay("preparing"):
            config = prepare(config)
            learner = learner_type(config)
        with TrainingRun(config, learner, folder) as run:
            if begun is not None:
                begun(run.folder)
            for batch in run.batches():
                with with_threads(config.learner_threads):
                    learned = learner.update(batch, run.share, run.stopwatch)
                run.record(learned)
    return run.summary
