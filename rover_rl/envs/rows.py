"""Tensordicts of unbatched environments, seen as batches of one."""

from __future__ import annotations

from tensordict import LazyStackedTensorDict, TensorDictBase


def in_rows(tensordict: TensorDictBase) -> TensorDictBase:
    """``tensordict`` of batch size ``[N, ...]`` as it is, and of batch size ``[]`` with one row, to be read.

    Example:
        >>> env = make_env(world_n="maze", num_envs=None)
        >>> in_rows(env.reset())["lidar"].shape
        torch.Size([1, 32])
    """
    # A lazy stack is quicker than a view of every entry, as few are read.
    return tensordict if tensordict.batch_dims else LazyStackedTensorDict(tensordict, stack_dim=0)
