"""Encoder of the privileged observation, for critics that know more than the policy."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from rover_rl.envs.privileged import FEATURES, MAP_BEARINGS, MAP_DISTANCES
from rover_rl.envs.sensors.base import mirrored_signs
from rover_rl.envs.sensors.standard import Target, WheelOdometry


def mirrored_map(local_map: Tensor) -> Tensor:
    """Returns the mirror image of the local map ``[..., distances * bearings]``: bearing b becomes -b."""
    image = local_map.unflatten(-1, (len(MAP_DISTANCES), MAP_BEARINGS)).flip(-1).roll(1, -1)
    return image.flatten(-2)


MIRROR: dict[NestedKey, Callable[[Tensor], Tensor]] = {
    ("privileged", "position"): partial(mirrored_signs, (1.0, -1.0, 1.0)),
    ("privileged", "attitude"): partial(mirrored_signs, (-1.0, 1.0, -1.0)),
    ("privileged", "velocities"): WheelOdometry().mirror,
    ("privileged", "target"): Target().mirror,
    ("privileged", "local_map"): mirrored_map,
}
"""Mirror image of the privileged observation, by key: that of the world, mirrored at the x axis."""


class PrivilegedEncoder(nn.Module):
    """Encodes the privileged observation as features of about [-1, 1].

    It leaves out the position and the heading, by which a critic would know one map by heart. They would also
    contradict mirror images, which belong to another map.

    Attributes:
        keys: entries to read.
        features: number of features.
    """

    keys: tuple[NestedKey, ...] = tuple(("privileged", key) for key in FEATURES if key != "position")
    features = 2 + 2 + 5 + 2 + len(MAP_DISTANCES) * MAP_BEARINGS + 4

    def __init__(self) -> None:
        super().__init__()
        reach = torch.tensor(MAP_DISTANCES).repeat_interleave(MAP_BEARINGS)
        self.register_buffer("_reach", reach, persistent=False)

    _reach: Tensor

    def forward(self, *entries: Tensor) -> Tensor:
        """Encodes the entries named in ``keys``, in this order: ``[..., features]``."""
        entry = {key[-1]: value for key, value in zip(self.keys, entries, strict=True)}
        path = entry["path_distance"]
        factors = [2 * (entry[key] - 1) for key in ("friction", "chassis_mass", "motor_torque")]
        parts = [3 * entry["attitude"][..., :2], WheelOdometry().encode(entry["velocities"])]
        parts += [Target().encode(entry["target"])]
        parts += [path / 5 - 1, path.log1p() - 1, entry["local_map"] / self._reach, *factors, entry["latency"] / 3]
        return torch.cat(parts, -1)
