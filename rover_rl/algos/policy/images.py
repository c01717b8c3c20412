"""Convolutions over the images among the features of an observation."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.modules import ConvNet

from rover_rl.envs.encoding import ObservationEncoder

CHANNELS, KERNELS = (16, 32, 32), (5, 3, 3)
"""Channels and kernel sizes of the convolutions, each of which halves rows and columns."""
UNITS = 64
"""Number of features of an image after the convolutions."""


class ImageFeatures(nn.Module):
    """Replaces each image among encoded features by :data:`UNITS` features: see :attr:`rover_rl.Sensor.image`.

    Args:
        encoder: encoder of the observation, at least one of whose sensors has images.

    Attributes:
        added: difference of the numbers of features after and before.

    Example:
        >>> encoder = ObservationEncoder(("target", "heights"))
        >>> ImageFeatures(encoder)(torch.zeros(1, encoder.features)).shape
        torch.Size([1, 69])
    """

    def __init__(self, encoder: ObservationEncoder) -> None:
        super().__init__()
        sensors = {key: encoder.sensors[key] for key in encoder.keys}
        self._sizes = {key: sensor.features for key, sensor in sensors.items()}
        self._shapes = {key: sensor.image for key, sensor in sensors.items() if sensor.image}
        self.networks = nn.ModuleDict({key: self._network(key) for key in self._shapes})
        self.added = sum(UNITS - self._sizes[key] for key in self._shapes)

    def _network(self, key: str) -> nn.Module:
        rows, columns = self._shapes[key]
        channels, paddings = self._sizes[key] // (rows * columns), [kernel // 2 for kernel in KERNELS]
        convolutions = ConvNet(
            in_features=channels,
            num_cells=list(CHANNELS),
            kernel_sizes=list(KERNELS),
            strides=2,
            paddings=paddings,
            activation_class=nn.ReLU,
        )
        count = convolutions(torch.zeros(1, channels, rows, columns)).shape[-1]
        image = nn.Unflatten(-1, (channels, rows, columns))
        return nn.Sequential(image, convolutions, nn.Linear(count, UNITS), nn.ReLU())

    def forward(self, features: Tensor) -> Tensor:
        """Returns features ``[..., n + added]`` of encoded features ``[..., n]``. Those after the encoder's stay."""
        sizes = [*self._sizes.values()]
        *parts, rest = features.split([*sizes, features.shape[-1] - sum(sizes)], -1)
        entries = zip(self._sizes, parts, strict=True)
        read = [self.networks[key](part) if key in self._shapes else part for key, part in entries]
        return torch.cat((*read, rest), -1)
