"""View of an unbatched environment's tensordict as a batch of one row."""

from __future__ import annotations

from tensordict import LazyStackedTensorDict, TensorDictBase


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
