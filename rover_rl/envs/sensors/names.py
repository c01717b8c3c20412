"""Names of the entries that a policy can read. Importing this module does not import PyTorch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rover_rl.envs.sensors import BUILT_IN

if TYPE_CHECKING:
    from rover_rl.envs.config import SensorLike


def require_entries(observation: Sequence[str], own: Sequence[SensorLike]) -> None:
    """Checks the names of the entries that a policy reads.

    Args:
        observation: names of the entries.
        own: sensors of one's own, as objects or by name.

    Raises:
        ValueError: if a name is unknown or given twice, or there is none, or a sensor is unknown.
    """
    known = tuple(BUILT_IN)
    if own:
        # Imports PyTorch.
        from rover_rl.envs.sensors.suite import own_sensors

        known += tuple(own_sensors(own))
    if not observation or len(set(observation)) < len(observation) or not set(observation) <= set(known):
        raise ValueError(f"observation must be some of {known}, each once, got {observation}")
