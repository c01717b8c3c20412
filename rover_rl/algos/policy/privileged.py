"""Encoder of the privileged observation, for critics that know more than the policy."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from rover_rl.envs.privileged import FEATURES, MAP_BEARINGS, MAP_DISTANCES

MIRROR_SIGNS: dict[NestedKey, tuple[float, ...]] = {
    ("privileged", "position"): (1.0, -1.0, 1.0),
    ("privileged", "attitude"): (-1.0, 1.0, -1.0),
    ("privileged", "velocities"): (1.0, -1.0),
    ("privileged", "target"): (1.0, -1.0),
}
"""Signs of the mirror image of the privileged observation: that of the world, mirrored at the x axis."""


def mirrored_map(local_map: Tensor) -> Tensor:
    """Returns the mirror image of the local map ``[..., distances * bearings]``: bearing b becomes -b."""
    image = local_map.unflatten(-1, (len(MAP_DISTANCES), MAP_BEARINGS)).flip(-1).roll(1, -1)
    return image.flatten(-2)


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
        distance, angle = entry["target"].split(1, -1)
        speed, yaw_rate = entry["velocities"].split(1, -1)
        path = entry["path_distance"]
        factors = [2 * (entry[key] - 1) for key in ("friction", "chassis_mass", "motor_torque")]
        parts = [3 * entry["attitude"][..., :2], speed, yaw_rate / 3]
        parts += [distance / 5 - 1, distance.log1p() - 1, angle.sin(), angle.cos(), angle / torch.pi]
        parts += [path / 5 - 1, path.log1p() - 1, entry["local_map"] / self._reach, *factors, entry["latency"] / 3]
        return torch.cat(parts, -1)
