"""TensorDicts without checks, for the step of an environment.

The public constructors of TensorDict check the shape and device of every entry, which takes longer than a step of a
small batch. The callers guarantee both. This is the only use of TensorDict's private API.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict


def unchecked_tensordict(
    entries: Mapping[str, Any], batch_size: Sequence[int], device: torch.device | None = None
) -> TensorDict:
    """Creates a TensorDict of entries on ``device`` whose shapes start with ``batch_size``, which is not checked."""
    return TensorDict._new_unsafe(dict(entries), batch_size=torch.Size(batch_size), device=device)
