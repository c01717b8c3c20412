"""Helpers of tests with checkpoints."""

from __future__ import annotations

import torch

from rover_rl.algos.policy.checkpoint import Checkpoint


def equal(one: Checkpoint, other: Checkpoint) -> bool:
    """Whether two checkpoints are the same to the last bit."""
    rest = [(each.config, each.steps, each.actor.keys()) for each in (one, other)]
    return rest[0] == rest[1] and all(torch.equal(one.actor[name], other.actor[name]) for name in one.actor)
