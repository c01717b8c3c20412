"""``EncodedObservation``: transform that adds the observation as one vector, scaled for networks."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from rover_rl.envs.encoding import ObservationEncoder


class EncodedObservation(Transform):
    """Adds ``observation``, float32 ``[N, n]``: the features of an encoder, about [-1, 1] each.

    Programs that expect one vector under TorchRL's usual name run with it, and networks learn from it without
    statistics of the observations.

    Args:
        encoder: encoder of the entries to read. ``None``: that of the environment that the transform is appended to,
            ``ObservationEncoder.of``, with all of its own sensors.

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
        """Encoder of the entries.

        Raises:
            ValueError: if there is none, and no environment.
        """
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
        """Adds ``observation``."""
        shape = (*observation_spec.shape, self.encoder.features)
        observation_spec[self.KEY] = Unbounded(shape=shape, dtype=torch.float32, device=observation_spec.device)
        return observation_spec
