"""Data collection in this process, or with TorchRL's collectors in several processes or on a Ray cluster."""

from __future__ import annotations

import faulthandler
import logging
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any, TypeAlias

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.multiprocessing import get_sharing_strategy, set_sharing_strategy
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor

from rover_rl.algos.config import TrainingConfig
from rover_rl.algos.train.env import SESSION_SEEDS, make_training_env
from rover_rl.algos.workers import interrupts_held, usable_cores
from rover_rl.native.threads import share_kernels

Batches: TypeAlias = Iterator[TensorDictBase]
MakeEnv: TypeAlias = Callable[..., EnvBase]
_LAST_LINES = 60  # number of lines of a failed worker's output that are reported
_FILES, _FILES_OF_A_WORKER = 512, 128  # numbers of files that a process may have open: shared tensors take one each
_POLL_INTERVAL = 1.0  # time between two checks of whether the workers are alive, s
_RAY_TIMEOUT = 10.0  # time to wait for Ray to report which worker has ended, s


class WorkerError(ChildProcessError):
    """Raised when a worker process has failed. The message contains the end of its output."""


@contextmanager
def collect(
    config: TrainingConfig,
    actor: ProbabilisticActor,
    session: int = 0,
    estimates: Mapping[str, Tensor] | None = None,
    folder: Path | None = None,
) -> Iterator[Batches]:
    """Opens a collector and yields an endless iterator over batches ``[num_envs, rollout_length]``.

    If the algorithm is ``asynchronous`` and there are several workers, each batch holds the rows of one worker,
    ``[rovers_per_worker, rollout_length]``, while the other workers continue. Workers receive the current weights of
    the actor whenever a batch is requested. The iterator raises :class:`WorkerError` within seconds after a worker has
    failed.

    Args:
        session: number of times the run has been resumed.
        estimates: state of the :class:`~rover_rl.algos.train.curriculum.Learnability` that a curriculum begins with.
        folder: folder of the run, in which pages watch it.
    """
    if config.collector == "process":
        env: Any = make_training_env(
            config, session=session, estimates=estimates, per_batch=config.on_gpu, watched=folder
        )
        try:
            yield _rollouts(env, actor, config.algorithm.rollout_length)
        finally:
            env.close(raise_if_closed=False)
        return
    make_env = partial(_make_env, config, session, estimates, folder)
    opened = _in_processes if config.collector == "processes" else _on_a_cluster
    with opened(config, actor, make_env) as batches:
        yield batches


def _make_env(
    config: TrainingConfig,
    session: int,
    estimates: Mapping[str, Tensor] | None,
    folder: Path | None,
    worker: int,
    log: Path | None,
) -> EnvBase:
    """Makes the environment of a worker: a process, whose errors are written to ``log``, or one on a cluster."""
    # TorchRL also makes an environment in the training process, to read its specs.
    in_process = log is not None and multiprocessing.parent_process() is not None
    if in_process or log is None:
        torch.manual_seed(config.seed + worker + session * SESSION_SEEDS)
        share_kernels(max(1, usable_cores() // config.workers))
    if log is None:
        torch.set_num_threads(1)
    elif in_process:
        # The training process handles Ctrl-C.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        # If the worker fails, the training process reports its traceback and the crash output of Bullet or Python.
        with log.open("wb", buffering=0) as file:
            os.dup2(file.fileno(), 2)
        faulthandler.enable(all_threads=False)
    # A worker on a cluster has no such folder.
    return make_training_env(config, worker, session, estimates, watched=None if log is None else folder)


def _rollouts(env: TransformedEnv, actor: ProbabilisticActor, length: int) -> Batches:
    """Yields endless batches ``[N, length]`` of consecutive steps, in which the actor explores.

    The data is that of TorchRL's collector, to the last bit. That one reads values from the device in every step, such
    as whether any episode has ended, and waits each time until a GPU has finished all its work. This loop reads none on
    a GPU: it resets ended rows by mask in every step, whether there are any or not. Transforms with
    ``batch_collected(batch)`` read what they need after each batch.
    """
    per_batch = [transform for transform in env.transform if hasattr(transform, "batch_collected")]
    current = env.reset()
    while True:
        steps = []
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            for _ in range(length):
                step = env.step(actor(current))
                steps.append(step)
                current = with_new_episodes(env, env.step_mdp(step))
            batch = torch.stack(steps, -1)
        for transform in per_batch:
            transform.batch_collected(batch)
        yield batch


def with_new_episodes(env: TransformedEnv, current: TensorDictBase) -> TensorDictBase:
    """Returns the data ``[N]`` before the next step: that of new episodes in rows whose episode has ended.

    ``EnvBase.reset`` would check the values of the mask and of the new data.
    """
    ended = current["done"]
    # On the CPU this check is cheap and saves most resets.
    if ended.device.type == "cpu" and not ended.any():
        return current
    begun = env._reset(TensorDict({"_reset": ended}, current.batch_size, device=current.device))

    def now(last: Tensor, new: Tensor | None) -> Tensor:
        new_rows = ended if last.ndim == ended.ndim else ended.reshape(-1, *[1] * (last.ndim - 1))
        return torch.where(new_rows, 0 if new is None else new, last)

    # The actor's outputs are left out: it writes them again.
    found = current.select(*begun.keys()).apply(now, begun, default=None)
    assert found is not None
    return found


def _collector(
    config: TrainingConfig, actor: ProbabilisticActor, make_env: MakeEnv, logs: Sequence[Path | None], **options: Any
) -> BaseCollector:
    """Makes TorchRL's collector with a worker for each of ``logs``."""
    asynchronous, frames = config.algorithm.asynchronous, config.num_envs * config.algorithm.rollout_length
    # Each batch of an asynchronous collector comes from one worker.
    frames = frames // config.workers if asynchronous else frames
    makers, workers = [partial(make_env, worker, log) for worker, log in enumerate(logs)], config.workers
    return Collector(makers, actor, num_collectors=workers, sync=not asynchronous, frames_per_batch=frames, **options)


@contextmanager
def _in_processes(config: TrainingConfig, actor: ProbabilisticActor, make_env: MakeEnv) -> Iterator[Batches]:
    options: dict[str, Any] = {"use_buffers": True, "num_threads": 1, "auto_register_policy_transforms": False}
    with _enough_files(config.workers), TemporaryDirectory(prefix="rover_rl-") as folder:
        logs = [Path(folder) / f"worker-{worker}" for worker in range(config.workers)]
        # Asynchronous batches come from one worker each and are not concatenated.
        joined = None if config.algorithm.asynchronous else 0
        with interrupts_held():
            collector = _collector(config, actor, make_env, logs, cat_results=joined, **options)
        try:
            yield _watched(collector, logs)
        finally:
            collector.shutdown(raise_on_error=False)


@contextmanager
def _enough_files(workers: int) -> Iterator[None]:
    """Lets this process open as many files as it may; if these are too few, tensors are shared by name instead."""
    before = get_sharing_strategy()
    try:
        import resource

        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        needed = _FILES + _FILES_OF_A_WORKER * workers
        most = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, most), hard))
        if max(soft, most) < needed:
            set_sharing_strategy("file_system")
    except ImportError:  # Windows has no such limit.
        pass
    try:
        yield
    finally:
        set_sharing_strategy(before)


def _watched(collector: BaseCollector, logs: list[Path]) -> Batches:
    """Yields the collector's batches until a worker fails."""
    batches = iter(collector)
    while True:
        try:
            batch = next(batches)
            yield batch
            _send_weights(collector)
        except (RuntimeError, OSError, EOFError) as error:
            raise WorkerError("\n".join((str(error), *map(_last_output, logs)))) from error


def _send_weights(collector: BaseCollector) -> None:
    """Sends the actor's weights to the workers. TorchRL alone waits forever for the reply of a dead worker."""
    reply: Future[None] = Future()

    def send() -> None:
        try:
            reply.set_result(collector.update_policy_weights_())
        except Exception as error:
            reply.set_exception(error)

    Thread(target=send, daemon=True).start()
    while not wait([reply], _POLL_INTERVAL).done:
        for number, process in enumerate(collector.procs):
            if process.exitcode is not None:
                raise RuntimeError(f"worker {number} ended (exit code {process.exitcode})")
    reply.result()


def _last_output(log: Path) -> str:
    lines = log.read_text(errors="replace").splitlines() if log.exists() else []
    return "\n".join((f"{log.name}:", *lines[-_LAST_LINES:])) if lines else f"{log.name} printed nothing"


@contextmanager
def _on_a_cluster(config: TrainingConfig, actor: ProbabilisticActor, make_env: MakeEnv) -> Iterator[Batches]:
    from ray.exceptions import RayError

    options = {
        "remote_configs": {"num_cpus": 1},
        # At any other time, an update waits for workers that are collecting.
        "update_after_each_batch": True,
        "collector_kwargs": {"track_traj_ids": False, "auto_register_policy_transforms": False},
    }
    ray: dict[str, Any] = {"backend": "ray", "total_frames": sys.maxsize, "backend_options": options}
    collector = _collector(config, actor, make_env, [None] * config.workers, **ray)

    def batches() -> Batches:
        try:
            collector.update_policy_weights_()
            # Iterating over the collector itself ends all workers before the failed one can be identified.
            for batch in collector.iterator():
                # Batches of several workers are stacked.
                yield batch if config.algorithm.asynchronous else batch.flatten(0, 1)
        except RayError as error:
            raise WorkerError(str(error)) from error
        except RuntimeError as error:
            # The error says only that the connection for weights is closed.
            raise WorkerError("\n".join((str(error), *_ended_actors(collector)))) from error

    try:
        yield batches()
    finally:
        collector.shutdown()


def connect() -> int:
    """Connects to the Ray cluster at ``RAY_ADDRESS``, else to one on this machine, else starts one. Idempotent.

    Returns the number of CPU cores of the cluster.
    """
    try:
        import ray
    except ImportError as error:
        raise ImportError('backend "ray" needs Ray: pip install "rover_rl[ray]"') from error
    if not ray.is_initialized():
        # The output of remote workers would disturb the progress bar. Their errors are reported separately.
        init = partial(ray.init, log_to_driver=False, logging_level=logging.ERROR)
        try:
            init(address="auto")
        except ConnectionError as error:
            if "RAY_ADDRESS" in os.environ:
                raise ConnectionError(
                    f"no Ray cluster answers at RAY_ADDRESS={os.environ['RAY_ADDRESS']}; "
                    "if it requires a token, set RAY_AUTH_MODE=token and copy its ~/.ray/auth_token to this machine"
                ) from error
            init(include_dashboard=False)
    return int(ray.cluster_resources().get("CPU", 0))


def _ended_actors(collector: BaseCollector) -> list[str]:
    """Ray's reports on the workers that have ended. This can take some seconds."""
    import ray

    replies = [worker.__ray_ready__.remote() for worker in collector.remote_collectors]
    reports = []
    for reply in ray.wait(replies, num_returns=len(replies), timeout=_RAY_TIMEOUT)[0]:
        try:
            ray.get(reply)
        except ray.exceptions.RayError as error:
            reports.append(str(error))
    return reports
