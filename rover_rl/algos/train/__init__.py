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
    from rover_rl.algos.policy.checkpoint import Checkpoint
    from rover_rl.algos.train.run import Learner, TrainingSummary

__all__ = ["train", "training_config", "untrained"]


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
    from rover_rl.algos.train.run import TrainingRun
    from rover_rl.native.threads import single_threaded

    with single_threaded():
        with ProgressDisplay("preparing"):
            learner = _learner(config)
            config = learner.config
        with TrainingRun(config, learner, folder) as run:
            if begun is not None:
                begun(run.folder)
            for batch in run.batches():
                run.record(learner.update(batch, run.share, run.stopwatch))
    return run.summary


def untrained(config: TrainingConfig) -> Checkpoint:
    """Returns the policy that :func:`train` begins with if the settings name a seed."""
    from rover_rl.algos.policy.checkpoint import Checkpoint
    from rover_rl.native.threads import single_threaded

    # Initial weights depend on the number of threads in their last bits.
    with single_threaded():
        learner = _learner(config)
    return Checkpoint(learner.config, 0, learner.actor.state_dict())


def _learner(config: TrainingConfig) -> Learner:
    from rover_rl.algos.train.run import prepare

    learner_type = getattr(import_module(f"{__name__}.{config.algo}"), f"{config.algo.upper()}Learner")
    learner: Learner = learner_type(prepare(config))
    return learner
