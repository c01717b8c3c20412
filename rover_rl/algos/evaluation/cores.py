"""Parallel work on the CPU cores of this machine."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from concurrent import futures
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache
from io import BytesIO
from multiprocessing.process import BaseProcess
from multiprocessing.sharedctypes import SynchronizedArray
from typing import Any, TypeVar

import torch
from torch import Tensor

from rover_rl.algos.workers import interrupts_held, usable_cores
from rover_rl.progress import ProgressDisplay, redirected_progress
from rover_rl.worlds import World

Item = TypeVar("Item")
Result = TypeVar("Result")
_POLL_INTERVAL = 0.2  # time between two updates of the display, s


def over_cores(
    work: Callable[[Item], Result], items: Sequence[Item], description: str, workers: int | None = None
) -> list[Result]:
    """Applies ``work`` to each item, with a process per CPU core or ``workers`` at most, and returns results in order.

    ``work`` is a module-level function, or a ``partial`` of one, whose standard output is discarded. Ctrl-C and errors
    end all processes. Raises ``ChildProcessError`` with the exit code or signal of a process that has ended.
    """
    workers = min(usable_cores() if workers is None else workers, len(items))
    with ProgressDisplay(description) as display:
        if workers > 1:
            return _in_processes(work, items, workers, display)
        results = []
        for number, item in enumerate(items):
            with redirected_progress(lambda fraction, done=number: display.update((done + fraction) / len(items))):  # type: ignore[misc]
                results.append(work(item))
        return results


def _in_processes(
    work: Callable[[Item], Result], items: Sequence[Item], workers: int, display: ProgressDisplay
) -> list[Result]:
    method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
    context = multiprocessing.get_context(method)
    # The fork server imports the modules once for all workers.
    context.set_forkserver_preload(["rover_rl.algos.evaluation.evaluate"])
    fractions, others = context.Array("d", len(items)), set(multiprocessing.active_children())
    pool = futures.ProcessPoolExecutor(workers, context, _start_worker, (fractions,))
    given: list[futures.Future[bytes]] = []
    processes: set[BaseProcess] = set()
    try:
        with interrupts_held():
            for number, item in enumerate(items):
                given.append(pool.submit(_apply, dumps((work, item)), number))
        processes |= set(multiprocessing.active_children()) - others
        while True:
            done, pending = futures.wait(given, _POLL_INTERVAL, futures.FIRST_EXCEPTION)
            results = {future: future.result() for future in done}  # raises the error of a worker
            if not pending:
                return [pickle.loads(results[future]) for future in given]
            # The pool may notice the end of a process only after the next result of another one.
            if any(process.exitcode is not None for process in processes):
                raise BrokenProcessPool("it has ended")
            display.update(sum(fractions[:]) / len(items))
    except BrokenProcessPool as error:
        raise ChildProcessError(_how_ended(processes, error)) from error
    finally:
        finished = all(future.done() for future in given)  # so are canceled ones
        pool.shutdown(wait=False, cancel_futures=True)
        if not finished:
            for process in set(multiprocessing.active_children()) - others:
                process.terminate()


def _how_ended(processes: set[BaseProcess], error: BrokenProcessPool) -> str:
    codes = {process.exitcode for process in processes} - {None, 0, -signal.SIGTERM}
    if not codes:
        return f"a worker process has failed: {str(error.__cause__ or error).strip().splitlines()[-1]}"
    code = codes.pop() or 0
    if code > 0:
        return f"a worker process has ended with exit code {code}"
    reason = ", perhaps because the memory is full" if code == -signal.SIGKILL else ""
    return f"a worker process has been ended by signal {-code} ({signal.strsignal(-code)}){reason}"


_fractions: SynchronizedArray[float]  # in a worker process: fraction of each item that is done


def _start_worker(fractions: SynchronizedArray[float]) -> None:
    global _fractions
    _fractions = fractions
    # The main process handles Ctrl-C, and has warned of the same robots and worlds.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    warnings.simplefilter("ignore", UserWarning)


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _apply(work_and_item: bytes, number: int) -> bytes:
    work, item = pickle.loads(work_and_item)
    with redirected_progress(lambda fraction: _fractions.__setitem__(number, fraction)):
        result = work(item)
    _fractions[number] = 1.0
    return dumps(result)


def dumps(content: Any) -> bytes:
    """Pickles anything by value, for :func:`pickle.loads` in another process, and a world once for all.

    PyTorch's own pickles pass a file descriptor for each tensor: hundreds of trajectories would need more than the
    1,024 open files that Linux allows by default.
    """
    buffer = BytesIO()
    _Pickler(buffer, pickle.HIGHEST_PROTOCOL).dump(content)
    return buffer.getvalue()


class _Pickler(pickle.Pickler):
    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, World):
            return _unpickled, (_pickled(value),)
        on_cpu = type(value) is Tensor and value.device.type == "cpu" and not value.requires_grad
        if on_cpu and value.dtype is not torch.bfloat16 and not value.is_complex():
            # The array of a slice holds the slice only. PyTorch would pickle all of the tensor that it belongs to.
            return torch.from_numpy, (value.numpy(),)
        return NotImplemented


_pickled = lru_cache(maxsize=64)(pickle.dumps)


@lru_cache(maxsize=64)
def _unpickled(world: bytes) -> World:
    return pickle.loads(world)
