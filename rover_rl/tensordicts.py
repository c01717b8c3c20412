"""TensorDicts without checks, and with a batch dimension."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import LazyStackedTensorDict, TensorDict, TensorDictBase


def unchecked_tensordict(
    entries: Mapping[str, Any], batch_size: Sequence[int], device: torch.device | None = None
) -> TensorDict:
    """Creates a TensorDict of entries on ``device`` whose shapes start with ``batch_size``, which is not checked.

    The public constructors of TensorDict check every entry, which takes longer than a step of a small batch. This is
    the only use of TensorDict's private API.
    """
    return TensorDict._new_unsafe(dict(entries), batch_size=torch.Size(batch_size), device=device)


def in_rows(tensordict: TensorDictBase) -> TensorDictBase:
    """Returns a read-only view with a batch dimension. A tensordict that has one is returned unchanged.

    Args:
        tensordict: tensordict of batch size ``[N, ...]`` or ``[]``.

    Example:
        >>> env = make_env(world_n="maze", num_envs=None)
        >>> in_rows(env.reset())["lidar"].shape
        torch.Size([1, 32])
    """
    # A lazy stack is faster than a view of every entry, because few entries are read.
    return tensordict if tensordict.batch_dims else LazyStackedTensorDict(tensordict, stack_dim=0)
