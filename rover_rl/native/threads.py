"""Number of CPU threads that share the work of kernels, which may be more than those of PyTorch."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

_kernels: list[int] = []


def kernel_threads() -> int:
    """Returns the number of PyTorch's threads, within :func:`single_threaded` that of before."""
    return _kernels[-1] if _kernels else torch.get_num_threads()


def share_kernels(threads: int) -> None:
    """Sets the number of threads of kernels from now on, such as the share of the cores that a worker has."""
    _kernels.append(threads)


@contextmanager
def single_threaded() -> Iterator[None]:
    """Limits PyTorch to one thread: small networks gain nothing from more, and on busy cores lose much.

    Kernels keep their threads.
    """
    before = torch.get_num_threads()
    _kernels.append(kernel_threads())
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _kernels.pop()
