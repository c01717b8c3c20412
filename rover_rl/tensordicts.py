"""TensorDicts without checks, for the step of an environment.

TensorDict's public constructors check every entry's shape and device, which takes longer than a step of a small batch.
The entries made here have the right shapes by construction. These are the only calls of TensorDict's private API.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict


def unchecked_tensordict(
    entries: Mapping[str, Any], batch_size: Sequence[int], device: torch.device | None = None
) -> TensorDict:
    """A TensorDict of ``entries`` that are known to fit its batch size and device."""
    return TensorDict._new_unsafe(dict(entries), batch_size=torch.Size(batch_size), device=device)
