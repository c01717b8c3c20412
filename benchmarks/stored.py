"""Worlds with stored starts and goals that a policy was trained for."""

from __future__ import annotations

from rover_rl.algos.evaluation.episodes import STORED_WORLDS
from rover_rl.algos.pretrained import load_pretrained, pretrained_names
from rover_rl.envs.config import EnvConfig
from rover_rl.names import Name


def stored_worlds(env: EnvConfig) -> list[str]:
    """Returns the worlds with stored starts and goals among those of a training; for a range, the world of its kind.

    Example:
        >>> stored_worlds(EnvConfig(world=("maze:0-99@0.2-0.8", "rooms:0-99", "moon")))
        ['maze', 'moon']
    """
    names = map(Name.parse, env.world_names)
    kinds = dict.fromkeys(name.part if name.is_range else str(name) for name in names)
    return [kind for kind in kinds if kind in STORED_WORLDS]


def stored_policies() -> list[str]:
    """Returns the pretrained policies that were trained in a world with stored starts and goals."""
    return [name for name in pretrained_names() if stored_worlds(load_pretrained(name).env)]
