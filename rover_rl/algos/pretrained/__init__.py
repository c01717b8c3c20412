"""Policies that come with the package, and what names of policies mean."""

from __future__ import annotations

from pathlib import Path

from rover_rl.algos.policy.checkpoint import Checkpoint

FOLDER = Path(__file__).parent
"""A checkpoint and a card for each: ``maze-sac.pt`` and ``maze-sac.md``."""


def pretrained_names() -> list[str]:
    """Names of the policies that come with the package, such as ``"maze-sac"``."""
    return sorted(path.stem for path in FOLDER.glob("*.pt"))


def load_pretrained(name: str) -> Checkpoint:
    """A policy that comes with the package.

    Raises:
        ValueError: if there is none of that name.

    Example:
        >>> actor = load_pretrained("moon-sac").make_actor()
    """
    if name not in pretrained_names():
        raise ValueError(f"there is no pretrained policy {name!r}; use one of {pretrained_names()}")
    return Checkpoint.load(FOLDER / f"{name}.pt")
