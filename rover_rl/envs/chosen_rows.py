"""``ChosenRows``: rows of a batch that something is computed for."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class ChosenRows:
    """The rows of a ``mask`` (bool ``[N, 1]``; ``None``: all), to compute what changes in them alone.

    On the CPU, these rows are selected. On an accelerator, this would synchronize with it: all rows are computed there,
    and the mask chooses from the results. ``are_selected`` tells which.
    """

    def __init__(self, mask: Tensor | None = None) -> None:
        self.mask: Any = mask
        self._index = None if mask is None or mask.device.type != "cpu" else mask.squeeze(-1).nonzero().squeeze(-1)
        self.are_selected = self._index is not None

    def of(self, values: Tensor) -> Tensor:
        """Returns the values ``[M, ...]`` of the rows, from those of all, ``[N, ...]``."""
        return values if self._index is None else values.index_select(0, self._index)

    def into(self, values: Tensor | None, changed: Tensor) -> Tensor:
        """Returns the values of all rows ``[N, ...]``, changed in these rows to ``[M, ...]``.

        Without values, the other rows may be anything.
        """
        if self._index is not None:
            values = changed.new_zeros(len(self.mask), *changed.shape[1:]) if values is None else values
            return values.index_copy(0, self._index, changed)
        if self.mask is None or values is None:
            return changed
        return torch.where(self.mask.reshape(-1, *[1] * (changed.ndim - 1)), changed, values)


EVERY_ROW = ChosenRows()
