"""Where decisions come from: TorchRL's collectors, in this process, in one a core, or on a Ray cluster."""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread

import torch
from tensordict import TensorDictBase
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor

from rover_rl.algos.config import TrainingConfig
from rover_rl.algos.train.env import SESSION_SEEDS, make_training_env

_LAST_LINES = 60
"""Of what a worker that failed has said."""
_PATIENCE = 1.0
"""Seconds between two looks at whether the workers live."""
_RAY_PATIENCE = 10.0
"""Seconds that Ray has to say which worker has ended."""


class WorkerError(ChildProcessError):
    """A process that simulates has failed; its last words are in the message."""


@contextmanager
def collecting(
    config: TrainingConfig, actor: ProbabilisticActor, decisions: int, session: int = 0
) -> Iterator[Iterator[TensorDictBase]]:
    """Batches ``[num_envs, decisions]`` without end; what makes them is closed in the end.

    Where the algorithm is ``asynchronous`` and there are several workers, each batch is of one worker's rows alone,
    ``[rovers_each, decisions]``, and the others go on while it is learned from. When a batch is asked for, workers are
    told the actor's weights of that moment.

    Args:
        config: of the training.
        actor: takes the actions.
        decisions: of each rover in a batch.
        session: how often the run has been resumed.

    Raises:
        WorkerError: by the iterator, within seconds of a worker's end.
    """
    frames = config.num_envs * decisions
    if config.backend == "ray":
        make = _on_a_cluster
    else:
        make = _in_processes if config.processes > 1 else _in_this_process
    # An asynchronous collector's batch is one worker's.
    with make(config, actor, frames // config.processes if config.asynchronous else frames, session) as batches:
        yield batches


@contextmanager
def _in_this_process(
    config: TrainingConfig, actor: ProbabilisticActor, frames: int, session: int
) -> Iterator[Iterator[TensorDictBase]]:
    collector = Collector(
        partial(make_training_env, config, session=session),
        actor,
        frames_per_batch=frames,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    try:
        yield iter(collector)
    finally:
        collector.shutdown()


@contextmanager
def _in_processes(
    config: TrainingConfig, actor: ProbabilisticActor, frames: int, session: int
) -> Iterator[Iterator[TensorDictBase]]:
    with TemporaryDirectory(prefix="rover_rl-") as folder:
        logs = [Path(folder) / f"worker-{worker}" for worker in range(config.processes)]
        collector = Collector(
            [partial(_make_worker_env, config, worker, session, log) for worker, log in enumerate(logs)],
            actor,
            num_collectors=config.processes,
            sync=not config.asynchronous,
            frames_per_batch=frames,
            # One worker's batch needs not be put together with others.
            cat_results=None if config.asynchronous else 0,
            use_buffers=True,
            num_threads=1,
            auto_register_policy_transforms=False,
        )
        try:
            yield _watched(collector, logs)
        finally:
            collector.shutdown(raise_on_error=False)


def _watched(collector: BaseCollector, logs: list[Path]) -> Iterator[TensorDictBase]:
    """The collector's batches, until one of its workers fails."""
    batches = iter(collector)
    while True:
        try:
            batch = next(batches)
            yield batch
            _tell_weights(collector)
        except (RuntimeError, OSError, EOFError) as error:
            raise WorkerError("\n".join((str(error), *map(_last_words, logs)))) from error


def _tell_weights(collector: BaseCollector) -> None:
    """Tells the workers the actor's weights; TorchRL by itself would wait for the answer of a dead one for ever."""
    done: Future[None] = Future()

    def tell() -> None:
        try:
            done.set_result(collector.update_policy_weights_())
        except Exception as error:
            done.set_exception(error)

    Thread(target=tell, daemon=True).start()
    while True:
        try:
            return done.result(timeout=_PATIENCE)
        except FutureTimeout:
            for number, process in enumerate(collector.procs):
                if process.exitcode is not None:
                    raise RuntimeError(f"worker {number} ended (exit code {process.exitcode})") from None


def _last_words(log: Path) -> str:
    lines = log.read_text(errors="replace").splitlines() if log.exists() else []
    return "\n".join((f"{log.name}:", *lines[-_LAST_LINES:])) if lines else f"{log.name} has said nothing"


def _make_worker_env(config: TrainingConfig, worker: int, session: int, log: Path) -> EnvBase:
    """A worker's rovers, in its process, which leaves Ctrl-C to the one that trains."""
    if multiprocessing.parent_process() is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        torch.manual_seed(config.seed + worker + session * SESSION_SEEDS)
        # Its traceback, or what Bullet or the interpreter say as they crash, is for the process that trains to tell.
        with log.open("wb", buffering=0) as file:
            os.dup2(file.fileno(), 2)
        faulthandler.enable(all_threads=False)
    return make_training_env(config, worker, session)


@contextmanager
def _on_a_cluster(
    config: TrainingConfig, actor: ProbabilisticActor, frames: int, session: int
) -> Iterator[Iterator[TensorDictBase]]:
    from ray.exceptions import RayError

    collector = Collector(
        [partial(_make_remote_env, config, worker, session) for worker in range(config.processes)],
        actor,
        num_collectors=config.processes,
        sync=not config.asynchronous,
        backend="ray",
        frames_per_batch=frames,
        total_frames=sys.maxsize,
        backend_options={
            "remote_configs": {"num_cpus": 1},
            # At any other moment this would wait for workers that are driving.
            "update_after_each_batch": True,
            "collector_kwargs": {"track_traj_ids": False, "auto_register_policy_transforms": False},
        },
    )

    def batches() -> Iterator[TensorDictBase]:
        try:
            collector.update_policy_weights_()
            # Iterating the collector itself would end all workers before the one that failed is known.
            for batch in collector.iterator():
                # Those of several workers come stacked.
                yield batch if config.asynchronous else batch.flatten(0, 1)
        except RayError as error:
            raise WorkerError(str(error)) from error
        except RuntimeError as error:
            # All that the connection for weights knows is that it is closed.
            raise WorkerError("\n".join((str(error), *_ended_actors(collector)))) from error

    try:
        yield batches()
    finally:
        collector.shutdown()


def _ended_actors(collector: BaseCollector) -> list[str]:
    """What Ray says of the workers that have ended; it can take some seconds to know."""
    import ray

    answers = [worker.__ray_ready__.remote() for worker in collector.remote_collectors]
    said = []
    for answer in ray.wait(answers, num_returns=len(answers), timeout=_RAY_PATIENCE)[0]:
        try:
            ray.get(answer)
        except ray.exceptions.RayError as error:
            said.append(str(error))
    return said


def _make_remote_env(config: TrainingConfig, worker: int, session: int) -> EnvBase:
    torch.set_num_threads(1)
    torch.manual_seed(config.seed + worker + session * SESSION_SEEDS)
    return make_training_env(config, worker, session)
