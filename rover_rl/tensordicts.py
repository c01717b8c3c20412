"""TensorDicts without checks or with a batch dimension, and functions that do not depend on PyTorch's defaults."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from tensordict import LazyStackedTensorDict, TensorDict, TensorDictBase

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
_CPU = torch.device("cpu")


def unchecked_tensordict(
    entries: Mapping[str, Any], batch_size: Sequence[int], device: torch.device | None = None
) -> TensorDict:
    """Creates a TensorDict of entries on ``device`` whose shapes start with ``batch_size``, which is not checked.

    The public constructors of TensorDict check every entry, which takes longer than a step of a small batch. This is
    the only use of TensorDict's private API.
    """
    return TensorDict._new_unsafe(dict(entries), batch_size=torch.Size(batch_size), device=device)


def in_rows(tensordict: TensorDictBase) -> TensorDictBase:
    """Returns a read-only view of batch size ``[1]`` if that of the tensordict is ``[]``, else the tensordict.

    Example:
        >>> env = make_env(world_n="maze", num_envs=None)
        >>> in_rows(env.reset())["lidar"].shape
        torch.Size([1, 32])
    """
    # A lazy stack is faster than a view of every entry, because few entries are read.
    return tensordict if tensordict.batch_dims else LazyStackedTensorDict(tensordict, stack_dim=0)


def with_torch_defaults(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Decorates a function so that it makes ordinary tensors, float32 on the CPU unless it says otherwise.

    It then does the same after ``torch.set_default_dtype`` and ``torch.set_default_device``, and within
    ``torch.inference_mode()``, whose tensors could not be changed outside of it.
    """

    @wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        made = torch.empty(0)
        if made.dtype is torch.float32 and made.device == _CPU and not made.is_inference():
            return function(*args, **kwargs)
        with ExitStack() as stack:
            stack.callback(torch.set_default_dtype, made.dtype)
            torch.set_default_dtype(torch.float32)
            if made.device != _CPU:
                stack.enter_context(_CPU)
            if made.is_inference():
                stack.enter_context(torch.inference_mode(False))
                stack.enter_context(torch.no_grad())
            return function(*args, **kwargs)

    return call
