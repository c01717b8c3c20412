"""Features of an observation, scaled for networks: ``ObservationEncoder``, and the transform that adds them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from rover_rl.envs.config import EnvConfig, LidarConfig, SensorLike
from rover_rl.envs.sensors.standard import Imu
from rover_rl.envs.sensors.suite import own_sensors, policy_sensors

DEFAULT_KEYS = ("lidar", "imu", "target", "velocities")
"""Entries of the observation that networks read by default. With the pose, a policy would memorize the map."""


class ObservationEncoder(nn.Module):
    """Encodes observations as features of about [-1, 1].

    The bounds of the observation space are not suitable as scales: distances of a few meters would become so small that
    a policy could hardly use them. The scales are constants, so that a policy needs no running statistics. Each sensor
    encodes its values: see :meth:`rover_rl.Sensor.encode`.

    ``keys`` are the entries of the observation to read, which may be those of ``sensors`` of one's own. ``north_up``
    adds lidar and target in map orientation: rotated by the yaw, so that they do not change when the rover turns in
    place; it needs ``lidar``, ``imu`` and ``target``. An unknown key or sensor raises ``ValueError``. ``features`` is
    the number of features. ``images`` are the rows and columns of the entries that are images, which networks read by
    ``image_network``: ``"convolutions"`` or ``"patches"``.

    Example:
        >>> encoder = ObservationEncoder(("lidar", "target"))
        >>> encoder(torch.full((1, 32), 12.0), torch.tensor([[5.0, 0.0]])).shape
        torch.Size([1, 37])
    """

    def __init__(
        self,
        keys: Sequence[str] = DEFAULT_KEYS,
        lidar_points: int = 32,
        north_up: bool = False,
        sensors: Sequence[SensorLike] = (),
        image_network: str = "convolutions",
    ) -> None:
        super().__init__()
        self.keys = tuple(keys)
        if north_up and not {"lidar", "imu", "target"} <= set(keys):
            raise ValueError(f"north_up needs lidar, imu and target, got {self.keys}")
        self.sensors = policy_sensors(LidarConfig(points=lidar_points), sensors)
        if unknown := [key for key in self.keys if key not in self.sensors]:
            raise ValueError(f"the observation has no entries {unknown}; use some of {[*self.sensors]}")
        self.sensors["imu"] = Imu(heading=north_up or "pose" in keys)
        self.images = {key: shape for key in self.keys if (shape := self.sensors[key].image)}
        self.image_network = image_network
        self._lidar_points, self._north_up = lidar_points, north_up
        self.features = sum(self.sensors[key].features for key in self.keys) + (lidar_points + 4 if north_up else 0)

    @classmethod
    def of(cls, config: EnvConfig, keys: Sequence[str] | None = None) -> ObservationEncoder:
        """Creates the encoder of some entries of an environment: ``keys``, or the default ones and its own sensors.

        The default leaves out the pose, and ``scan_pose`` and ``lidar_mask``, which come with randomization, unless
        they are among its sensors.
        """
        keys = (*DEFAULT_KEYS, *own_sensors(config.own_sensors)) if keys is None else keys
        return cls(keys, config.lidar.points, sensors=config.own_sensors)

    def forward(self, *observation: Tensor) -> Tensor:
        """Encodes the entries named in ``keys``, in this order (m, rad, m/s, rad/s): ``[..., features]``."""
        entries = dict(zip(self.keys, observation, strict=True))
        if "lidar" in entries and (points := entries["lidar"].shape[-1]) != self._lidar_points:
            raise ValueError(f"the policy reads {self._lidar_points} lidar points, got {points}")
        parts = [self.sensors[key].encode(value) for key, value in entries.items()]
        if self._north_up:
            parts.append(self._map_oriented(entries["lidar"], entries["imu"][..., 2:], entries["target"]))
        return torch.cat(parts, -1)

    def _map_oriented(self, ranges: Tensor, yaw: Tensor, target: Tensor) -> Tensor:
        """Encodes lidar and target rotated by the yaw; readings are interpolated between neighbors."""
        points = ranges.shape[-1]
        shifted = (torch.arange(points, device=yaw.device) - yaw * (points / (2 * math.pi))) % points
        floor = shifted.floor()
        index = floor.long() % points
        left, right = ranges.gather(-1, index), ranges.gather(-1, (index + 1) % points)
        ranges = torch.lerp(left, right, shifted - floor)
        distance, angle = target.split(1, -1)
        direction = torch.cat(((angle + yaw).sin(), (angle + yaw).cos()), -1)
        return torch.cat((self.sensors["lidar"].encode(ranges), direction, direction * distance / 4), -1)


class EncodedObservation(Transform):
    """Adds ``observation``, float32 ``[N, n]``: the features of an encoder, about [-1, 1] each.

    Programs that expect one vector under TorchRL's usual name run with it, and networks learn from it without
    statistics of the observations. ``encoder`` is by default ``ObservationEncoder.of`` the environment that it is
    appended to.

    Example:
        >>> env = make_env(world_n="maze", num_envs=4).append_transform(EncodedObservation())
        >>> env.rollout(3)["observation"].shape
        torch.Size([4, 3, 41])
    """

    KEY = "observation"
    """Name of the vector."""

    def __init__(self, encoder: ObservationEncoder | None = None) -> None:
        super().__init__()
        self._encoder = encoder

    @property
    def encoder(self) -> ObservationEncoder:
        if self._encoder is None:
            if self.container is None:
                raise ValueError("append EncodedObservation() to an environment, or give it an encoder")
            self._encoder = ObservationEncoder.of(self.container.config)
        return self._encoder

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        with torch.no_grad():
            features = self.encoder(*(next_tensordict.get(key) for key in self.encoder.keys))
        return next_tensordict.set(self.KEY, features)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if missing := [key for key in self.encoder.keys if tensordict_reset.get(key, None) is None]:
            raise ValueError(f"the encoder reads {missing}, and the observation has {[*tensordict_reset.keys()]}")
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        shape = (*observation_spec.shape, self.encoder.features)
        observation_spec[self.KEY] = Unbounded(shape=shape, dtype=torch.float32, device=observation_spec.device)
        return observation_spec
