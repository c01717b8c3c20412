"""Settings of training without parts, as short YAML files and files of version 0.1 have them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rover_rl.envs.config import Randomization
from rover_rl.plain import to_plain

RENAMED = {
    "decisions": "rollout_length",
    "repeat": "action_repeat",
    "episode_steps": "length",
    "warmup": "learning_starts",
    "buffer": "buffer_size",
    "entropy": "entropy_coef",
    "mirror": "mirror_augmentation",
    "spread": "max_std",
}
"""Today's names of settings by their names in version 0.1."""


def in_parts(data: Mapping[str, Any], homes: Mapping[str, str]) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Settings without parts, put into their parts; those of version 0.1 under today's names.

    Args:
        data: settings by name.
        homes: part of each setting, by the setting's name.

    Returns:
        The parts, and the settings that belong to none, sorted.
    """
    current = _today(data)
    parts: dict[str, dict[str, Any]] = {}
    for name in current.keys() & homes.keys():
        parts.setdefault(homes[name], {})[name] = current[name]
    return parts, sorted(map(str, current.keys() - homes.keys()))


def _today(data: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of version 0.1 as today's; those of today as they are."""
    current = {RENAMED.get(name, name): value for name, value in data.items()}
    if "reverse" in current and not current.pop("reverse"):
        current["action"] = {"min_speed": 0.0}
    if "randomize" in current and current.pop("randomize"):
        current["randomization"] = to_plain(Randomization.typical())
    if current.get("backend") == "ray":
        current |= {"backend": "bullet", "collector": "ray"}
    if current.get("device") == "cpu":
        current["device"] = None
    return current
