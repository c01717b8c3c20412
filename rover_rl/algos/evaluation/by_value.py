"""Pickles that processes exchange. They hold tensors by value.

PyTorch's own pickles between processes pass a file descriptor for each tensor. Hundreds of trajectories then need more
than the 1,024 open files that Linux allows by default.
"""

from __future__ import annotations

import pickle
from functools import lru_cache
from io import BytesIO
from typing import Any

import torch
from torch import Tensor

from rover_rl.sims.worlds import World

_KEPT = 64
"""Number of pickled and of unpickled worlds that a process keeps."""

loads = pickle.loads
"""Unpickles what :func:`dumps` has pickled."""


def dumps(content: Any) -> bytes:
    """Pickles anything by value.

    A world arrives as the same object each time, so that what is computed once per world, such as its free space, is
    computed once per process.
    """
    buffer = BytesIO()
    _Pickler(buffer, pickle.HIGHEST_PROTOCOL).dump(content)
    return buffer.getvalue()


class PickledLater:
    """Content that is pickled when it is sent, and that arrives as bytes for :func:`loads`.

    Errors in unpickling are then raised where the bytes are used. Raised while receiving, they would end the process.

    Args:
        content: anything.
    """

    def __init__(self, content: Any) -> None:
        self._content = content

    def __reduce__(self) -> tuple[type[bytes], tuple[bytes]]:
        return bytes, (dumps(self._content),)


class _Pickler(pickle.Pickler):
    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, World):
            return _unpickled, (_pickled(value),)
        if (
            type(value) is Tensor
            and value.device.type == "cpu"
            and value.dtype in _IN_NUMPY
            and not value.requires_grad
        ):
            # The array of a slice holds the slice only. PyTorch would pickle all of the tensor that it belongs to.
            return torch.from_numpy, (value.numpy(),)
        return NotImplemented


_IN_NUMPY = {torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64, torch.float32, torch.float64}


@lru_cache(maxsize=_KEPT)
def _pickled(world: World) -> bytes:
    return pickle.dumps(world)


@lru_cache(maxsize=_KEPT)
def _unpickled(world: bytes) -> World:
    return pickle.loads(world)
