"""Policies that do one thing, for tests."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase


def straight(td: TensorDictBase) -> TensorDictBase:
    """Drives at the goal, whatever is in the way, and slowly while it is not ahead."""
    angle = td["target"][..., 1:]
    return td.set("action", torch.cat((angle.cos().clamp(min=0), angle), -1))


def standing(td: TensorDictBase) -> TensorDictBase:
    return td.set("action", torch.zeros(len(td), 2))


def ahead(td: TensorDictBase) -> TensorDictBase:
    return td.set("action", torch.tensor([[1.0, 0.0]]).expand(len(td), 2))
