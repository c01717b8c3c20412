"""Experiment trackers beside ``progress.csv``: TorchRL's loggers, opened for the folder of a run."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torchrl.record.loggers import CSVLogger, Logger, MLFlowLogger, TensorboardLogger, WandbLogger
from torchrl.record.loggers.trackio import TrackioLogger

from rover_rl.algos.config import TrainingConfig
from rover_rl.algos.config_files import SEED_SUFFIX, plain

PROJECT = "rover_rl"  # default name of the project in Weights & Biases, Trackio and MLflow


class Trackers:
    """Sends rows of values to experiment trackers.

    A tracker that fails during training is reported once with ``say`` and left out from then on: training is worth more
    than its record, which ``progress.csv`` holds anyway. The files of Weights & Biases, TensorBoard and CSV are in the
    folder of the run, the database of MLflow is beside it, and Trackio has a folder of its own (environment variable
    ``TRACKIO_DIR``). ``resumed_at`` is the number of steps that a resumed run goes on from; ``None``: a new run.

    Raises:
        ValueError: if a tracker cannot be opened, for example because nobody is logged in.
    """

    def __init__(
        self, names: Sequence[str], folder: Path, config: TrainingConfig, resumed_at: int | None, say: Callable
    ) -> None:
        self._say = say
        self._open: dict[str, Logger] = {}
        for name in names:
            try:
                self._open[name] = _OPENERS[name](folder, config, resumed_at)
            except Exception as error:  # Each library has errors of its own.
                self.close()
                raise ValueError(f"the tracker {name} cannot be opened: {' '.join(str(error).split())}") from error

    def add(self, row: dict[str, float]) -> None:
        def send(logger: Logger) -> None:
            logger.log_metrics(row, step=int(row["steps"]))
            logger.flush()

        self._each(send)

    def close(self) -> None:
        self._each(_close)
        self._open.clear()

    def _each(self, action: Callable[[Logger], None]) -> None:
        for name, logger in [*self._open.items()]:
            try:
                action(logger)
            except Exception as error:  # Each library has errors of its own.
                del self._open[name]
                self._say(f"The tracker {name} has failed and gets no more values: {' '.join(str(error).split())}")


def _close(logger: Logger) -> None:
    logger.shutdown()
    if isinstance(logger, MLFlowLogger):
        # TorchRL leaves its run open, and the next one could not begin.
        import mlflow

        mlflow.end_run()


def check_trackers(names: Sequence[str]) -> None:
    for name in names:
        if find_spec(name) is None:
            raise ImportError(f'the tracker {name} needs its package: pip install "rover_rl[{name}]"')


def _open_tensorboard(folder: Path, config: TrainingConfig, resumed_at: int | None) -> Logger:
    from tensorboard.compat.proto.event_pb2 import Event, SessionLog

    logger = TensorboardLogger("tensorboard", str(folder))
    if resumed_at is not None:
        # TensorBoard then hides the earlier events after this step, whose batches are collected again.
        start = Event(session_log=SessionLog(status=SessionLog.START))
        logger.experiment._get_file_writer().add_event(start, resumed_at)
    return logger


def _open_wandb(folder: Path, config: TrainingConfig, resumed_at: int | None) -> Logger:
    # Its folders are wandb/run-DATE-ID and wandb/offline-run-DATE-ID.
    earlier = sorted((folder / "wandb").glob("*run-*-*")) if resumed_at is not None else []
    return WandbLogger(
        folder.name,
        save_dir=folder,
        id=earlier[-1].name.rpartition("-")[2] if earlier else None,
        project=os.environ.get("WANDB_PROJECT", PROJECT),
        group=re.sub(rf"{SEED_SUFFIX}\d+$", "", folder.name),
        config=plain(config),
        log_env_packages=False,
    )


def _open_trackio(folder: Path, config: TrainingConfig, resumed_at: int | None) -> Logger:
    resume = "never" if resumed_at is None else "allow"
    return TrackioLogger(folder.name, os.environ.get("TRACKIO_PROJECT", PROJECT), resume=resume, config=plain(config))


def _open_mlflow(folder: Path, config: TrainingConfig, resumed_at: int | None) -> Logger:
    import mlflow

    database = os.environ.get("MLFLOW_TRACKING_URI", f"sqlite:///{folder.parent / 'mlflow.db'}")
    logger = MLFlowLogger(os.environ.get("MLFLOW_EXPERIMENT_NAME", PROJECT), database)
    # TorchRL names the experiment and not the run, and needs OmegaConf for the settings.
    mlflow.set_tag("mlflow.runName", folder.name)
    mlflow.log_params(_with_dots(plain(config)))
    return logger


def _with_dots(data: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in data.items():
        flat |= _with_dots(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return flat


_OPENERS: dict[str, Callable[[Path, TrainingConfig, int | None], Logger]] = {
    "csv": lambda folder, config, resumed_at: CSVLogger("csv", str(folder)),
    "tensorboard": _open_tensorboard,
    "wandb": _open_wandb,
    "trackio": _open_trackio,
    "mlflow": _open_mlflow,
}
