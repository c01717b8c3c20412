"""Training loop, independent of the algorithm: budget, folder, log and checkpoints.

The algorithms are in :mod:`rover_rl.algos.train.ppo` and :mod:`rover_rl.algos.train.sac`.
"""

from __future__ import annotations

import math
import secrets
import signal
import threading
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor

from rover_rl.algos.archives import first_not_finite
from rover_rl.algos.config import TrainingConfig, with_settings
from rover_rl.algos.config_files import run_config
from rover_rl.algos.policy.checkpoint import CHECKPOINT, SETTINGS, Checkpoint
from rover_rl.algos.train import run_folder
from rover_rl.algos.train.collectors import WorkerError, collect, connect
from rover_rl.algos.train.curriculum import CurriculumRecord
from rover_rl.algos.train.env import training_physics
from rover_rl.algos.train.fine_tuning import load_source
from rover_rl.algos.train.live import forget_live_rovers
from rover_rl.algos.train.progress import ProgressLog, Stopwatch, batch_statistics, time_columns
from rover_rl.algos.train.trackers import Trackers, check_trackers
from rover_rl.algos.workers import default_workers
from rover_rl.envs.config import DEFAULT_PHYSICS
from rover_rl.envs.rewards import pays_for_goals, reward_components
from rover_rl.envs.specs import available_device
from rover_rl.names import check_training_seed
from rover_rl.robots import check_training_robots
from rover_rl.worlds import World
from rover_rl.worlds.pool import WorldPool, draws_worlds


class Learner(ABC):
    """Actor, other networks and their update. The interface between an algorithm and :class:`TrainingRun`."""

    logged: ClassVar[tuple[str, ...]]
    """Values of the loss that are logged for each gradient step."""
    config: TrainingConfig
    actor: ProbabilisticActor
    _loss: nn.Module
    _optimizer: torch.optim.Optimizer

    @abstractmethod
    def update(self, batch: TensorDictBase, share: float, stopwatch: Stopwatch) -> dict[str, float]:
        """Learns from a batch ``[N, T]`` of decisions, after a fraction ``share`` of training; returns what to log."""

    def schedule(self, share: float) -> None:
        """Sets what changes along training, for the next batch, after a fraction ``share`` of it."""
        settings = self.config.algorithm
        for group in self._optimizer.param_groups:
            group["lr"] = settings.learning_rate * (1 - share if settings.anneal else 1.0)

    def start_from(self, actor: Mapping[str, Tensor]) -> None:
        self.actor.load_state_dict(actor)

    def weights(self) -> dict[str, Tensor]:
        return dict(self._loss.named_parameters())

    def state_dict(self) -> dict[str, Any]:
        return {"loss": self._loss.state_dict(), "optimizer": self._optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._loss.load_state_dict(state["loss"])
        self._optimizer.load_state_dict(state["optimizer"])

    def _means(self, steps: list[Tensor]) -> dict[str, float]:
        means = torch.stack(steps).mean(0).tolist() if steps else [math.nan] * len(self.logged)
        learned = {"gradient_steps": len(steps), "learning_rate": self._optimizer.param_groups[0]["lr"]}
        return learned | dict(zip(self.logged, means, strict=True))


@dataclass(frozen=True)
class TrainingSummary:
    """Summary of a training run, with the steps of all rovers and the minutes of all sessions together.

    ``shares`` are those of this session's time, by activity. ``reached_before`` names the limits, ``"total_steps"`` and
    ``"max_minutes"``, that the run had reached before this session, which therefore trained nothing.
    """

    folder: Path
    steps: int
    minutes: float
    interrupted: bool
    shares: dict[str, float]
    reached_before: tuple[str, ...] = ()

    @property
    def checkpoint(self) -> Path:
        return self.folder / CHECKPOINT


class TrainingRun:
    """Context manager of a new or resumed training run.

    The run's folder holds ``config.yaml`` (settings, and sessions that changed some), ``progress.csv`` (one row per
    batch), ``checkpoint.pt`` (the policy), ``training_state.pt`` (the state from which training continues),
    ``snapshots/`` (earlier policies), with a curriculum ``curriculum.csv`` (the worlds that were drawn), and what its
    trackers write there. Files are replaced as a whole, every ``checkpoint_minutes`` and at the end. Ctrl-C and SIGTERM
    end the run after the current batch; a second one ends it immediately. A run whose weights become NaN or infinite,
    or whose files cannot be written, keeps its last checkpoint.
    """

    def __init__(self, config: TrainingConfig, learner: Learner, folder: Path | None = None) -> None:
        self.config, self.learner = config, learner
        self.steps = self.updates = self._session = 0
        self._minutes_before = self._saved_at = 0.0
        self._saved_steps: int | None = None
        self._stopping = False
        self._curriculum = None if config.collection.curriculum == "none" else CurriculumRecord(config)
        with ExitStack() as self._lock:
            record = None
            if folder is not None:
                # Raises before a folder that is no run is locked.
                run_config(folder)
                self._lock.enter_context(run_folder.training_lock(folder))
                record = run_folder.RunRecord.of(folder, config)
                self._resume(folder)
            if self._saved_steps is None and (source := load_source(config)) is not None:
                learner.start_from(source.actor)
            if folder is None:
                default = run_folder.default_name(config)
                folder = run_folder.new_run_folder(config.run.runs, config.run.name, default)
                self._lock.enter_context(run_folder.training_lock(folder))
            self.folder, self._record = folder, record or run_folder.RunRecord(folder / SETTINGS, config)
            if self._saved_steps is None:
                self._record.begin()
            self._from_start = record is not None and self._saved_steps is None
            self._steps_before = self._collected = self.steps
            self.stopwatch = Stopwatch()
            self._last_snapshot = int(self._share_at(self._minutes_before) * config.run.snapshots)
            self._log = ProgressLog(self.folder, self.updates, self.steps)
            used = {"total_steps": self.steps, "max_minutes": self._minutes_before}
            limits = {name: getattr(config.run, name) for name in used}
            self._reached_before = tuple(name for name in used if limits[name] and used[name] >= limits[name])
            # From here on, the lock is held until the run ends.
            self._lock = self._lock.pop_all()

    def _resume(self, folder: Path) -> None:
        path = folder / run_folder.STATE
        if not path.is_file():
            if (folder / CHECKPOINT).is_file():
                raise ValueError(
                    f"{folder} has a checkpoint, but no {path.name} to go on from; "
                    f"begin a new run with --config {folder / SETTINGS}"
                )
            return
        state = run_folder.load_state(path)
        try:
            self.steps, self.updates, self._minutes_before = state["steps"], state["updates"], state["minutes"]
            self._session = state["session"] + 1
            self.learner.load_state_dict(state["learner"])
            if self._curriculum and "curriculum" in state:
                self._curriculum.load_state_dict(state["curriculum"])
            torch.set_rng_state(state["random"])
            if self.config.on_gpu and "random_on_gpu" in state:
                torch.cuda.set_rng_state(state["random_on_gpu"], self.config.device)
        except (RuntimeError, ValueError, KeyError, TypeError) as error:
            raise ValueError("the run's training state does not fit its settings") from error
        if (diverged := first_not_finite(self.learner.weights())) is not None:
            raise ValueError(f"{path} holds NaN or infinity in the weights {diverged}: it cannot be resumed")
        self._saved_steps = self.steps

    @property
    def minutes(self) -> float:
        return self._minutes_before + self.stopwatch.elapsed / 60

    @property
    def share(self) -> float:
        """Fraction of the budget that is used, of steps or time, whichever is larger. At most 1."""
        return self._share_at(self.minutes)

    def _share_at(self, minutes: float) -> float:
        limit = self.config.run.max_minutes
        return min(1.0, max(self.steps / self.config.run.total_steps, minutes / limit if limit else 0.0))

    @property
    def summary(self) -> TrainingSummary:
        shares = self.stopwatch.shares()
        return TrainingSummary(self.folder, self.steps, self.minutes, self._stopping, shares, self._reached_before)

    def __enter__(self) -> TrainingRun:
        # Python allows signal handlers in the main thread only.
        self._handlers = {}
        if threading.current_thread() is threading.main_thread():
            self._handlers = {number: signal.signal(number, self._stop) for number in (signal.SIGINT, signal.SIGTERM)}
        # A finished run has nothing more to tell.
        names = () if self._reached_before else self.config.run.logger
        resumed_at = self.steps if self.updates else None
        self._trackers = Trackers(names, self.folder, self.config, resumed_at, self._log.say)
        self._log.__enter__()
        # The time to open trackers, with logins and databases, is not that of training.
        self.stopwatch = Stopwatch()
        if self._from_start:
            self._log.say(f"{self.folder} has no checkpoint yet: its training begins from the start")
        if self.config.env.physics == DEFAULT_PHYSICS and training_physics(self.config) == "planar":
            self._log.say("All worlds are level: training takes --physics planar (full engine: --physics full)")
        if self._record.changed:
            self._log.say(f"{self.folder} continues after {self.steps:,} steps with {self._record}")
        return self

    def __exit__(self, *raised: Any) -> None:
        error = raised[1]
        try:
            if isinstance(error, Exception):
                self._require_finite()
            # A worker fails while the run waits for its batch, so the learner is in a consistent state.
            failed = isinstance(error, WorkerError)
            if (error is None or failed) and self.steps > self._steps_before:
                self._save()
            if failed:
                self._log.say(f"A worker failed. To continue: rover-rl train --resume {self.folder}")
        finally:
            forget_live_rovers(self.folder)
            self._log.__exit__(*raised)
            self._trackers.close()
            for number, handler in self._handlers.items():
                signal.signal(number, handler)
            self._lock.close()

    def _stop(self, number: int, frame: object) -> None:
        if self._stopping:
            raise KeyboardInterrupt
        self._stopping = True
        self._log.say(f"{signal.Signals(number).name}: stopping after this batch; send it again to stop immediately")

    def batches(self) -> Iterator[TensorDictBase]:
        """Yields batches of :func:`collect` until the run ends, at least one in a new run.

        Update the learner with each batch, then call :meth:`record`.
        """
        if self._reached_before:
            return
        estimates = self._curriculum.learnability.state_dict() if self._curriculum else None
        self.learner.schedule(self.share)
        with collect(self.config, self.learner.actor, self._session, estimates, self.folder) as batches:
            repeat = self.config.collection.action_repeat
            while not self.updates or (self.share < 1 and not self._stopping):
                requested = self.stopwatch.elapsed
                batch = next(batches)
                self.stopwatch.collected(batch, self.config.rovers_per_worker, self.stopwatch.elapsed - requested)
                self._collected = self.steps + batch.numel() * repeat
                self._batch_statistics = batch_statistics(batch, repeat)
                if self._curriculum:
                    self._batch_statistics |= self._curriculum(batch)
                yield batch
                self.learner.schedule(self.share)

    def record(self, learned: dict[str, float]) -> None:
        """Logs the current batch and saves snapshots and checkpoints that are due."""
        self.steps, self.updates = self._collected, self.updates + 1
        counters = {"updates": self.updates, "minutes": self.minutes, "steps": self.steps}
        shares = time_columns(self.stopwatch.shares())
        self._trackers.add(self._log.add({**counters, **self._batch_statistics, **learned, **shares}))
        self._require_finite()
        snapshot = int(self.share * self.config.run.snapshots)
        if snapshot > self._last_snapshot:
            self._last_snapshot = snapshot
            self._checkpoint().save(self.folder / "snapshots" / f"{self.steps:09d}.pt")
        if self.minutes - self._saved_at >= self.config.run.checkpoint_minutes:
            self._save()
        try:
            self._log.show(self.share)
        except (OSError, SystemExit):
            # The reader of the output has closed it, as with "| head". Saves the progress.
            self._save()
            raise

    def _checkpoint(self) -> Checkpoint:
        state = self.learner.actor.state_dict().items()
        return Checkpoint(self.config, self.steps, {name: value.detach().to("cpu", copy=True) for name, value in state})

    def _save(self) -> None:
        self._saved_at = self.minutes
        state: dict[str, Any] = {"learner": self.learner.state_dict(), "random": torch.get_rng_state()}
        state |= {"steps": self.steps, "updates": self.updates, "minutes": self.minutes, "session": self._session}
        if self.config.on_gpu:
            state["random_on_gpu"] = torch.cuda.get_rng_state(self.config.device)
        if self._curriculum:
            state["curriculum"] = self._curriculum.state_dict()
        run_folder.save_run(self.folder, self._checkpoint(), state)
        self._record.trained(self._steps_before)
        if self._curriculum:
            self._curriculum.write(self.folder)
        self._saved_steps = self.steps

    def _require_finite(self) -> None:
        if (diverged := first_not_finite(self.learner.weights())) is None:
            return
        lower = f"--learning-rate {self.config.algorithm.learning_rate / 3:.1g}"
        advice = f"there is no checkpoint yet; begin a new run with a lower learning rate, such as {lower}"
        if self._saved_steps is not None:
            advice = (
                f"the last good checkpoint is {self.folder / CHECKPOINT}, of {self._saved_steps:,} steps; "
                f"continue from it with a lower learning rate: rover-rl train --resume {self.folder} {lower}"
            )
        raise FloatingPointError(
            f"training diverged after {self._collected:,} steps, with NaN or infinity in {diverged}; {advice}"
        )


def prepare(config: TrainingConfig) -> TrainingConfig:
    """Checks the settings and seeds PyTorch. Call it before creating a learner.

    Returns the settings, with the default number of workers and a random seed if none was given.
    """
    config.check()
    check_trackers(config.run.logger)
    env = config.env.fitted()
    config = replace(config, env=env)
    for world in env.worlds:
        check_world(world)
    if config.collection.curriculum != "none" and not draws_worlds(env.world):
        raise ValueError(
            f"curriculum chooses among the worlds of a range, as in 'maze:*', or of a WorldPool, got {env.world!r}"
        )
    check_training_robots(env.robot)
    if not pays_for_goals(reward_components(env.reward, env.contract_reward)):
        warnings.warn(
            f"no component of reward={env.reward!r} pays for a goal, so that the policy need not learn to reach one; "
            "add it to the contract's, which does: --reward contract ..., or reward=[*contract_reward(), ...]",
            stacklevel=3,
        )
    available_device(config.device)
    if env.seed is None:
        config = with_settings(config, seed=secrets.randbits(31))
    workers = config.workers
    if config.collector == "ray":
        # Connects before TrainingRun installs its SIGTERM handler, because Ray installs one, too.
        cores, given = connect(), config.collection.workers
        if (given or 1) > cores:
            raise ValueError(f"workers={given} need a processor each, and the Ray cluster has {cores}")
        workers = given or default_workers(config.groups, cores)
    torch.manual_seed(config.seed)
    return with_settings(config, workers=workers)


def check_world(world: str | World) -> None:
    if isinstance(world, str):
        check_training_seed(world)
    WorldPool.of(world)[0]
