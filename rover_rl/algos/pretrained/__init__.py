"""Pretrained policies of the package."""

from __future__ import annotations

from pathlib import Path

from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.registry import perhaps

FOLDER = Path(__file__).parent
"""Folder with a checkpoint and a model card of each policy, such as ``anywhere.pt`` and ``anywhere.md``."""


def pretrained_names() -> list[str]:
    """Returns the names of the pretrained policies, such as ``"anywhere"``."""
    return sorted(path.stem for path in FOLDER.glob("*.pt"))


def load_pretrained(name: str) -> Checkpoint:
    """Loads a pretrained policy.

    Args:
        name: name of the policy, such as ``"moon-sac"``.

    Raises:
        ValueError: if there is no policy of that name.

    Example:
        >>> actor = load_pretrained("moon-sac").make_actor()
    """
    known = pretrained_names()
    if name not in known:
        raise ValueError(f"there is no pretrained policy {name!r}{perhaps(name, known)}; use one of {known}")
    return Checkpoint.load(FOLDER / f"{name}.pt")
